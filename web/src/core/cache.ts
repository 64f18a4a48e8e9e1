/** An LRU cache of file contents by key, limited in bytes. */
export class LruCache {
  private readonly kept = new Map<string, Uint8Array>();
  private size = 0;

  constructor(private readonly limit: number) {}

  get(key: string): Uint8Array | undefined {
    const content = this.kept.get(key);
    if (content) this.put(key, content);
    return content;
  }

  has(key: string): boolean {
    return this.kept.has(key);
  }

  put(key: string, content: Uint8Array): void {
    this.drop(key);
    this.kept.set(key, content);
    this.size += content.length;
    for (const oldest of this.kept.keys()) {
      if (this.size <= this.limit) break;
      this.drop(oldest);
    }
  }

  /** Keys and contents, the oldest first. */
  entries(): IterableIterator<[string, Uint8Array]> {
    return this.kept.entries();
  }

  clear(): void {
    this.kept.clear();
    this.size = 0;
  }

  drop(key: string): void {
    this.size -= this.kept.get(key)?.length ?? 0;
    this.kept.delete(key);
  }
}
