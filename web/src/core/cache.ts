/** An LRU cache of file contents by SHA-256, limited in bytes. */
export class LruCache {
  private readonly kept = new Map<string, Uint8Array>();
  private size = 0;

  constructor(private readonly limit: number) {}

  get(sha256: string): Uint8Array | undefined {
    const content = this.kept.get(sha256);
    if (content) this.put(sha256, content);
    return content;
  }

  has(sha256: string): boolean {
    return this.kept.has(sha256);
  }

  put(sha256: string, content: Uint8Array): void {
    this.drop(sha256);
    this.kept.set(sha256, content);
    this.size += content.length;
    for (const oldest of this.kept.keys()) {
      if (this.size <= this.limit) break;
      this.drop(oldest);
    }
  }

  clear(): void {
    this.kept.clear();
    this.size = 0;
  }

  drop(sha256: string): void {
    this.size -= this.kept.get(sha256)?.length ?? 0;
    this.kept.delete(sha256);
  }
}
