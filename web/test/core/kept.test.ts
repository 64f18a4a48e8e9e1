import { beforeEach, describe, expect, test, vi } from "vitest";
import { digestOfBrowser, type File } from "../../src/core/download";
import { Kept } from "../../src/core/kept";

const digest = digestOfBrowser as NonNullable<typeof digestOfBrowser>;

const BASE = new URL("https://example.org/garden/");

/** The caches of a browser. */
class Caches {
  readonly all = new Map<string, Map<string, ArrayBuffer>>();
  async open(name: string) {
    const kept = this.all.get(name) ?? new Map<string, ArrayBuffer>();
    this.all.set(name, kept);
    return {
      keys: async () => [...kept.keys()],
      match: async (key: string) => new Response(kept.get(key)),
      put: async (url: URL, reply: Response) =>
        void kept.set(`${url}-${kept.size}`, await reply.arrayBuffer()),
      delete: async (key: string) => kept.delete(key),
    };
  }
  get entries() {
    return this.all.get(`sagesplat ${BASE}`) ?? new Map<string, ArrayBuffer>();
  }
}

let caches: Caches;
const visit = () => Kept.open(BASE, caches as unknown as CacheStorage) as Promise<Kept>;
const contentOf = (i: number) => Uint8Array.from({ length: 100 * i }, (_, k) => (k * i) % 251);
const files = await Promise.all(
  [1, 2, 3, 4].map(async (i): Promise<File> => {
    const content = contentOf(i);
    const sha256 = (await digest(content)).slice(0, 4);
    return { uri: "grass.sgst", offset: i, bytes: content.length, key: `grass.sgst:${i}`, sha256 };
  }),
);
const some = (...numbers: number[]) => numbers.map((i) => [`grass.sgst:${i}`, contentOf(i)] as const);

beforeEach(() => {
  caches = new Caches();
});

describe("what is kept of earlier visits", () => {
  test("comes back, once", async () => {
    const first = await visit();
    await first.add(some(1, 2));
    await first.add(some(1, 2, 3));
    await first.add(some(3));
    expect(caches.entries.size).toBe(2);
    const second = await visit();
    expect([...(await second.read(files, digest))].sort()).toEqual(some(1, 2, 3));
    await second.add(some(1, 2, 3));
    expect(caches.entries.size).toBe(2);
  });

  test("is known from the second visit on", async () => {
    const storage = new Map<string, string>();
    vi.stubGlobal("localStorage", {
      getItem: (key: string) => storage.get(key) ?? null,
      setItem: (key: string, value: string) => void storage.set(key, value),
    });
    const kept = await visit();
    expect(Kept.isKnown(BASE)).toBe(false);
    await kept.add(some(1));
    expect(Kept.isKnown(BASE)).toBe(true);
    expect(Kept.isKnown(new URL("https://example.org/other/"))).toBe(false);
    await (await visit()).read(files, digest);
    expect(Kept.isKnown(BASE)).toBe(true);
    caches = new Caches(); // the browser has cleared it
    await (await visit()).read(files, digest);
    expect(Kept.isKnown(BASE)).toBe(false);
    vi.unstubAllGlobals();
    expect(Kept.isKnown(BASE)).toBe(false);
    await (await visit()).add(some(2));
    expect(caches.entries.size).toBe(1);
  });

  test("is forgotten where it is of another bundle, damaged or no entry", async () => {
    await (await visit()).add(some(1));
    await (await visit()).add(some(2));
    const [one, two] = [...caches.entries.keys()] as [string, string];
    new Uint8Array(caches.entries.get(one) as ArrayBuffer)[60]! ^= 1;
    caches.entries.set("empty", new ArrayBuffer(0));
    caches.entries.set("noise", Uint8Array.from({ length: 50 }, (_, i) => i).buffer);
    expect([...(await (await visit()).read(files, digest))]).toEqual(some(2));
    expect([...caches.entries.keys()]).toEqual([two]);
    expect((await (await visit()).read(files.slice(2), digest)).size).toBe(0);
    expect(caches.entries.size).toBe(0);
  });

  test("is nothing where the browser has no caches or refuses them", async () => {
    expect(await Kept.open(BASE, undefined)).toBeNull();
    const refusing = { open: () => Promise.reject(new DOMException("no", "SecurityError")) };
    expect(await Kept.open(BASE, refusing as unknown as CacheStorage)).toBeNull();
  });

  test("a full disk is no error", async () => {
    const kept = await visit();
    caches.entries.set = () => {
      throw new DOMException("no room", "QuotaExceededError");
    };
    await kept.add(some(4));
  });
});
