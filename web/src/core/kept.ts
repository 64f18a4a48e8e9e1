/** Files, or ranges of them, that were downloaded in earlier visits: Chromium's own cache keeps few ranges. */

import { type Digest, type File, intact } from "./download";
import { remember, remembered } from "./storage";

const LIMIT = 64 * 2 ** 20; // bytes of a bundle

type Contents = Iterable<readonly [key: string, content: Uint8Array]>;

/**
 * What the browser keeps of a bundle, with the cache that pages have. An entry has the contents that came together: the
 * length of an index (4 bytes), the index (JSON: keys and lengths), and the contents. Nothing here rejects: what
 * cannot be kept is downloaded again.
 */
export class Kept {
  private readonly keys = new Set<string>();
  private bytes = 0;

  private constructor(
    private readonly store: Cache,
    private readonly base: URL,
  ) {}

  /** Whether an earlier visit kept something of a bundle, without waiting for it: the cache takes its time to open. */
  static isKnown(base: URL): boolean {
    return Boolean(remembered(nameOf(base)));
  }

  /** Null where the browser keeps nothing: without https, in private windows, in pages from the disk. */
  static async open(base: URL, caches: CacheStorage | undefined = globalThis.caches): Promise<Kept | null> {
    try {
      return caches ? new Kept(await caches.open(nameOf(base)), base) : null;
    } catch {
      return null;
    }
  }

  /** The contents of files, by key, as far as they are here and as the manifest has them; forgets entries of others. */
  async read(files: readonly File[], digest: Digest): Promise<Map<string, Uint8Array>> {
    const wanted = new Map(files.map((file) => [file.key, file]));
    const found = new Map<string, Uint8Array>();
    try {
      await Promise.all(
        (await this.store.keys()).map(async (request) => {
          const reply = await this.store.match(request);
          const all = unpacked((await reply?.arrayBuffer()) ?? new ArrayBuffer(0));
          const own = all.filter(([key]) => wanted.has(key));
          const checks = own.map(([key, content]) => intact({ digest }, wanted.get(key) as File, content));
          const isSound = await Promise.all(checks).then(
            () => own.length > 0,
            () => false,
          );
          if (!isSound) return this.store.delete(request);
          for (const [key, content] of own) found.set(key, content);
          return this.count(all);
        }),
      );
    } catch {
      // the browser has cleared it meanwhile
    }
    if (!found.size && Kept.isKnown(this.base)) remember(nameOf(this.base), ""); // of no use any more
    return found;
  }

  /** Keeps contents that are not kept yet. */
  async add(contents: Contents): Promise<void> {
    const added = [...contents].filter(([key]) => !this.keys.has(key));
    const bytes = added.reduce((sum, [, { length }]) => sum + length, 0);
    if (!added.length || this.bytes + bytes > LIMIT) return;
    this.count(added);
    try {
      await this.store.put(new URL(`kept/${Date.now()}`, this.base), new Response(packed(added)));
      remember(nameOf(this.base), "kept");
    } catch {
      // no room
    }
  }

  private count(contents: Contents): void {
    for (const [key, content] of contents) {
      this.keys.add(key);
      this.bytes += content.length;
    }
  }
}

const nameOf = (base: URL): string => `sagesplat ${base.href}`;

function packed(contents: readonly (readonly [string, Uint8Array])[]): Blob {
  const index = new TextEncoder().encode(JSON.stringify(contents.map(([key, { length }]) => [key, length])));
  return new Blob([
    Uint32Array.of(index.length),
    index,
    ...contents.map(([, content]) => content),
  ] as BlobPart[]);
}

/** The contents of an entry; of what is none: none. */
function unpacked(entry: ArrayBuffer): [string, Uint8Array][] {
  try {
    let at = 4 + new DataView(entry).getUint32(0, true);
    const index: [string, number][] = JSON.parse(new TextDecoder().decode(new Uint8Array(entry, 4, at - 4)));
    return index.map(([key, length]) => {
      at += length;
      return [key, new Uint8Array(entry.slice(at - length, at))];
    });
  } catch {
    return [];
  }
}
