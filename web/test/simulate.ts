/** A clock, a network and a renderer that tests are in charge of: nothing here waits, everything repeats. */

import type { Clock, Fetch, Reply } from "../src/core/download";
import type { Format, Handle, Manifest, Renderer } from "../src/types";

/** Random numbers from 0 to 1, the same ones for a seed (mulberry32). */
export function seeded(seed: number): () => number {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}

/** Lets promises settle, without letting time pass. */
export async function settled(): Promise<void> {
  for (let i = 0; i < 50; i++) await null;
}

/** Time that passes when a test says so. */
export class VirtualClock implements Clock {
  private time = 0;
  private due: { at: number; run: () => void }[] = [];

  now(): number {
    return this.time;
  }

  after(ms: number, run: () => void): () => void {
    const timer = { at: this.time + Math.max(ms, 0), run };
    this.due.push(timer);
    return () => {
      this.due = this.due.filter((other) => other !== timer);
    };
  }

  /** Lets time pass; what is due runs in order, `each` after every moment at which something ran. */
  async pass(ms: number, each: () => void = () => {}): Promise<void> {
    const end = this.time + ms;
    await settled();
    for (;;) {
      const next = this.due.reduce((a, b) => (b.at < a.at ? b : a), { at: Infinity, run: () => {} });
      if (next.at > end) break;
      this.due = this.due.filter((other) => other !== next);
      this.time = next.at;
      next.run();
      await settled();
      each();
    }
    this.time = end;
  }
}

/** What to do with a request instead of answering it. */
export type Fault =
  | "offline"
  | "hang"
  | "cut"
  | "corrupt"
  | "truncated"
  | "longer"
  | "bodiless"
  | "stalls"
  | "junk"
  | "wrong range"
  | number;

interface Flow {
  left: number; // bytes until the next piece
  piece: () => void;
}

const PIECE = 8192; // bytes

/** Files over a link: a round trip per request, then all downloads share the bandwidth evenly. */
export class Network {
  readonly files = new Map<string, Uint8Array>();
  /** By path, bytes over the link where they are fewer: with gzip. */
  readonly packed = new Map<string, number>();
  /** By path, of each request. */
  readonly asked: string[] = [];
  aborted: string[] = [];
  finished: string[] = [];
  /** Faults by path, of this and all further requests; "*" is for all. A list is used up, one a request. */
  readonly faults = new Map<string, Fault | Fault[]>();
  most = 0; // downloads at once
  ranges = true; // whether it answers with ranges
  /** The ranges that were asked for, as PATH START-END. */
  readonly askedRanges: string[] = [];
  private flows: Flow[] = [];
  private open = 0;
  private queue: (() => void)[] = [];
  private since = 0;
  private stop = () => {};

  constructor(
    readonly clock: VirtualClock,
    public bandwidth = 1e6, // bytes a second
    public latency = 100, // ms
    public connections = Infinity, // at once; a browser has 6 without HTTP/2
  ) {}

  readonly fetch: Fetch = async (url, init) => {
    const path = new URL(url).pathname.slice(1);
    this.asked.push(path);
    const fault = this.faultOf(path);
    const signal = init?.signal ?? null;
    if (this.open >= this.connections) await this.turn(signal, path);
    this.most = Math.max(this.most, this.open + 1);
    this.open += 1;
    try {
      await this.wait(fault === "hang" ? Infinity : this.latency, signal, path);
      if (fault === "offline") throw new TypeError("network error");
    } catch (error) {
      this.close();
      throw error;
    }
    const content = this.files.get(path);
    const status = typeof fault === "number" ? fault : content ? 200 : 404;
    const tag = content && `"${fnv(content)}"`;
    const matches = tag !== undefined && new Headers(init?.headers).get("If-None-Match") === tag;
    if (status !== 200 || !content || matches) {
      this.close();
      return this.reply(matches ? 304 : status, null, tag);
    }
    if (fault === "bodiless") {
      this.close();
      return this.reply(200, null, tag);
    }
    const range = rangeOf(init);
    if (range) this.askedRanges.push(`${path} ${range[1]}-${range[2]}`);
    if (!range || !this.ranges) {
      return this.reply(200, this.body(path, this.corrupt(content, fault), fault, signal), tag);
    }
    const [start, end] = [Number(range[1]), Math.min(Number(range[2]), content.length - 1)];
    if (start >= content.length) {
      this.close();
      return this.reply(416, null, tag);
    }
    const part = this.corrupt(content.subarray(start, end + 1), fault);
    const said = fault === "wrong range" ? start + 1 : start;
    const body = this.body(path, part, fault, signal);
    return this.reply(206, body, tag, `bytes ${said}-${end}/${content.length}`);
  };

  private faultOf(path: string): Fault | undefined {
    const found = this.faults.get(path) ?? this.faults.get("*");
    return Array.isArray(found) ? found.shift() : found;
  }

  private corrupt(content: Uint8Array, fault: Fault | undefined): Uint8Array {
    if (fault === "truncated") return content.slice(0, content.length - 10);
    if (fault === "longer") return Uint8Array.from([...content, 0]);
    if (fault !== "corrupt") return content;
    const wrong = content.slice();
    wrong[wrong.length >> 1] = (wrong[wrong.length >> 1] ?? 0) ^ 1;
    return wrong;
  }

  private reply(status: number, body: Reply["body"], tag: string | undefined, range = ""): Reply {
    return {
      ok: status >= 200 && status < 300,
      status,
      headers: { get: (name) => ({ ETag: tag, "Content-Range": range })[name] || null },
      body,
      text: async () => {
        const reader = body?.getReader();
        const decoder = new TextDecoder();
        let text = "";
        for (;;) {
          const next = await reader?.read();
          if (!next || next.done) return text;
          text += decoder.decode(next.value, { stream: true });
        }
      },
    };
  }

  private body(path: string, content: Uint8Array, fault: Fault | undefined, signal: AbortSignal | null) {
    let at = 0;
    const share = (this.packed.get(path) ?? content.length) / content.length;
    const read = async () => {
      if (at >= content.length || (fault === "cut" && at > content.length / 2)) {
        this.close();
        if (fault === "cut") throw new TypeError("connection reset");
        this.finished.push(path);
        return { done: true };
      }
      const size = Math.min(PIECE, content.length - at);
      try {
        if (fault === "stalls" && at > content.length / 2) await this.wait(Infinity, signal, path);
        await this.flow(size * share, signal, path);
      } catch (error) {
        this.close();
        throw error;
      }
      at += size;
      return { done: false, value: content.slice(at - size, at) };
    };
    return { getReader: () => ({ read }) };
  }

  /** Waits until a connection is free, first come, first served. */
  private turn(signal: AbortSignal | null, path: string): Promise<void> {
    return this.abortable(signal, path, (resolve) => {
      this.queue.push(resolve);
      return () => {
        this.queue = this.queue.filter((other) => other !== resolve);
      };
    });
  }

  private close(): void {
    this.open -= 1;
    this.queue.shift()?.();
  }

  private wait(ms: number, signal: AbortSignal | null, path: string): Promise<void> {
    return this.abortable(signal, path, (resolve) => {
      return ms < Infinity ? this.clock.after(ms, resolve) : () => {};
    });
  }

  private flow(bytes: number, signal: AbortSignal | null, path: string): Promise<void> {
    return this.abortable(signal, path, (resolve) => {
      const flow: Flow = { left: bytes, piece: resolve };
      this.advance();
      this.flows.push(flow);
      this.schedule();
      return () => {
        this.advance();
        this.flows = this.flows.filter((other) => other !== flow);
        this.schedule();
      };
    });
  }

  private abortable(
    signal: AbortSignal | null,
    path: string,
    begin: (resolve: () => void) => () => void,
  ): Promise<void> {
    return new Promise((resolve, reject) => {
      const abort = () => {
        if (!this.aborted.includes(path)) this.aborted.push(path);
        stop();
        reject(new DOMException("aborted", "AbortError"));
      };
      const stop = begin(() => {
        signal?.removeEventListener("abort", abort);
        resolve();
      });
      if (signal?.aborted) abort();
      else signal?.addEventListener("abort", abort, { once: true });
    });
  }

  /** Gives each download its part of what the link carried since the last time. */
  private advance(): void {
    const now = this.clock.now();
    const each = (((now - this.since) / 1000) * this.bandwidth) / Math.max(this.flows.length, 1);
    for (const flow of this.flows) flow.left -= each;
    this.since = now;
  }

  private schedule(): void {
    this.stop();
    if (!this.flows.length) return;
    const least = Math.min(...this.flows.map((flow) => flow.left));
    const wait = (1000 * Math.max(least, 0) * this.flows.length) / this.bandwidth;
    this.stop = this.clock.after(wait, () => {
      this.advance();
      const done = this.flows.filter((flow) => flow.left <= 1e-6);
      this.flows = this.flows.filter((flow) => flow.left > 1e-6);
      this.schedule();
      for (const flow of done) flow.piece();
    });
  }
}

/** Puts files of the right sizes there for all increments of a manifest. */
export function putIncrements(network: Network, { labels, pack }: Manifest): void {
  if (pack) network.files.set(pack.uri, new Uint8Array(pack.bytes));
  for (const { uri, bytes, offset = 0 } of labels.flatMap(({ cells }) => cells.flatMap((c) => c.levels))) {
    const size = offset + bytes;
    if (bytes && size > (network.files.get(uri)?.length ?? 0)) network.files.set(uri, new Uint8Array(size));
  }
}

/** The first and the last byte that a request asks for, as matched; null: for all. */
export const rangeOf = (init?: RequestInit): RegExpExecArray | null =>
  /^bytes=(\d+)-(\d+)$/.exec(new Headers(init?.headers).get("Range") ?? "");

/** A short digest (FNV-1a) in place of sha-256, at once. */
export function fnv(bytes: Uint8Array): string {
  let hash = 0x811c9dc5;
  for (const byte of bytes) hash = Math.imul(hash ^ byte, 0x01000193);
  return (hash >>> 0).toString(16).padStart(64, "0");
}
export const digest = async (bytes: Uint8Array): Promise<string> => fnv(bytes);

/** Draws nothing, but knows what it would, and complains of every misuse. */
export class FakeRenderer implements Renderer {
  readonly drawn = new Set<Handle>();
  readonly alive = new Set<Handle>();
  readonly uploaded = new Map<number, readonly Handle[]>(); // by cell: what is drawn, and what was drawn above it
  decoded = 0;
  swaps: { show: readonly Handle[]; hide: readonly Handle[] }[] = [];
  readonly corrupt = new Set<string>(); // "cell/level" that cannot be decoded
  begins: readonly number[] = [1]; // levels that a stream begins with
  palettes: readonly (string | undefined)[] = []; // hashes of labels' palettes, which the last streams need
  /** Called after every swap. */
  watch: () => void = () => {};

  constructor(
    private readonly clock: Clock,
    private readonly delay = 5, // ms to decode
  ) {}

  decode(
    label: number,
    cell: number,
    level: number,
    bytes: Uint8Array,
    format: Format,
    below: readonly Uint8Array[] = [],
    palette?: Parameters<Renderer["decode"]>[6],
  ): Promise<Handle> {
    const begin = this.begins.findLast((first) => first <= level) ?? 1;
    if (below.length !== (format === "stream" ? level - begin : 0)) throw new Error("without what is below");
    const needed = level >= (this.begins.at(-1) ?? 1) ? this.palettes[label] : undefined;
    if (palette?.key !== needed || (palette && fnv(palette.bytes) !== needed)) {
      throw new Error("not with its palette");
    }
    const handle: Handle = { label, cell, level, count: bytes.length };
    return new Promise((resolve, reject) => {
      this.clock.after(this.delay, () => {
        if (this.corrupt.has(`${cell}/${level}`)) return reject(new Error("not a splat file"));
        this.alive.add(handle);
        this.decoded += 1;
        resolve(handle);
      });
    });
  }

  swap(show: readonly Handle[], hide: readonly Handle[]): void {
    for (const handle of hide) if (!this.drawn.delete(handle)) throw new Error("hides what is not drawn");
    for (const handle of show) {
      if (!this.alive.has(handle)) throw new Error("shows what was disposed of");
      if (this.drawn.has(handle)) throw new Error("shows what is drawn");
      this.drawn.add(handle);
    }
    for (const { cell } of [...show, ...hide]) {
      const before = this.uploaded.get(cell) ?? [];
      const now = this.drawnOf(cell);
      if (!now.every((handle, i) => handle === before[i])) this.uploaded.set(cell, now);
    }
    this.swaps.push({ show, hide });
    this.watch();
  }

  dispose(handle: Handle): void {
    if (this.drawn.has(handle)) throw new Error("disposes of what is drawn");
    if (!this.alive.delete(handle)) throw new Error("disposes twice");
    const { cell } = handle;
    if (this.uploaded.get(cell)?.includes(handle)) this.uploaded.set(cell, this.drawnOf(cell));
  }

  /** Levels drawn of a cell, ascending. */
  levels(cell: number): number[] {
    return this.drawnOf(cell).map(({ level }) => level);
  }

  private drawnOf(cell: number): Handle[] {
    return [...this.drawn].filter((h) => h.cell === cell).sort((a, b) => a.level - b.level);
  }
}
