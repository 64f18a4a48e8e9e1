/** Coded streams: the nested levels of a category, decoded level by level. docs/formats.md specifies them. */

import { Block, Columns, LARGEST } from "./columns";
import { HEADER_BYTES, type Header, readHeader } from "./header";
import type { Palette } from "./palette";
import { Reader } from "./rans";

const MAX_COUNT = 10_000_000;
const PER_BYTE = 128; // Gaussians in a byte, at most
const SMALLEST = 32; // Gaussians of a block: a power of two
const ALL_SECOND = 255; // weight of a level whose Gaussians have one opacity, which counts as both

/** Makes of a stream's Gaussians what a caller wants of a level. */
export interface Sink<Level> {
  /** A level to be filled; with it come second opacities of the `deferred` Gaussians before it. */
  begin(header: Header, count: number, deferred: number, palette: Palette | null): Level;
  /** Takes the first `count` rows of a block as the rows of the level from `start` on. */
  put(level: Level, block: Block, start: number, count: number): void;
  /** Takes the second opacities of a block as those of the deferred Gaussians from `start` on. */
  putSeconds(level: Level, block: Block, start: number, count: number): void;
}

/** Decodes a stream while its bytes arrive. */
export class StreamDecoder<Level> {
  private waiting: Uint8Array = new Uint8Array(0);
  private header: Header | null = null;
  private columns: Columns | null = null;
  private done = 0; // Gaussians
  private deferred = new Uint8Array(0); // first opacities of the newest Gaussians, those without second ones
  private levels = 0;

  /** @param palette - of the file, if it has one */
  constructor(
    private readonly sink: Sink<Level>,
    private readonly palette: Palette | null = null,
  ) {}

  /** Whether all levels are decoded. */
  get isComplete(): boolean {
    return this.levels === this.header?.levels;
  }

  /** Whether bytes are here of a level that is not complete. */
  get isWithin(): boolean {
    return this.waiting.length > 0;
  }

  /** Takes the next bytes of the stream; the levels that they complete. Throws for a damaged stream. */
  push(bytes: Uint8Array): Level[] {
    this.waiting = this.waiting.length ? joined(this.waiting, bytes) : bytes;
    if (!this.header) {
      if (this.waiting.length < HEADER_BYTES) return [];
      this.header = readHeader(this.waiting);
      if (this.header.palette && !this.palette) throw new Error("no palette");
      if (this.header.palette) this.palette?.check(this.header);
      this.columns = new Columns(this.header, this.header.palette ? (this.palette?.count ?? 0) : 0);
      this.waiting = this.waiting.subarray(HEADER_BYTES);
    }
    const found: Level[] = [];
    while (this.waiting.length) {
      if (this.levels === this.header.levels) throw new Error("bytes after the last level");
      const level = this.next(this.header);
      if (!level) break;
      found.push(level);
    }
    return found;
  }

  /** The next level, if all of it is here. */
  private next(header: Header): Level | null {
    const [count, afterCount] = number(this.waiting, 0);
    const [size, afterSize] = number(this.waiting, afterCount);
    const start = afterSize + Number(header.twoOpacities);
    if (count > Math.min(MAX_COUNT - this.done, PER_BYTE * size) || (!count && size)) {
      throw new Error("a level with more Gaussians than fit");
    }
    if (Number.isNaN(size) || this.waiting.length < start + size) return null;
    const weight = header.twoOpacities ? (this.waiting[afterSize] as number) : ALL_SECOND;
    const deferred = count && weight ? this.deferred.length : 0;
    const level = this.sink.begin(header, count, deferred, header.palette ? this.palette : null);
    if (count) this.decode(this.waiting.subarray(start, start + size), level, count, weight);
    this.waiting = this.waiting.subarray(start + size);
    this.levels++;
    return level;
  }

  private decode(payload: Uint8Array, level: Level, total: number, weight: number): void {
    const columns = this.columns as Columns;
    const block = blockOf(this.header as Header);
    const reader = new Reader(payload);
    if (weight) this.decodeDeferred(reader, level);
    const deferred = new Uint8Array(weight ? 0 : this.deferred.length + total);
    deferred.set(this.deferred);
    let before = 0;
    for (let at = 0; at < total; ) {
      const left = untilEnd(this.done);
      const count = Math.min(left, total - at);
      before = columns.decode(reader, block, count, before, weight > 0 && weight < ALL_SECOND);
      this.sink.put(level, block, at, count);
      if (!weight) deferred.set(block.opacities.subarray(0, count), this.deferred.length + at);
      if (count === left) columns.endBlock();
      at += count;
      this.done += count;
    }
    this.deferred = deferred;
    reader.finish();
  }

  private decodeDeferred(reader: Reader, level: Level): void {
    const columns = this.columns as Columns;
    const block = blockOf(this.header as Header);
    for (let at = 0; at < this.deferred.length; ) {
      const count = Math.min(untilEnd(at), this.deferred.length - at);
      block.opacities.set(this.deferred.subarray(at, at + count));
      columns.decodeSeconds(reader, block, count);
      columns.endBlock();
      this.sink.putSeconds(level, block, at, count);
      at += count;
    }
    this.deferred = new Uint8Array(0);
  }
}

/** Gaussians until the block ends, after `done` of them. */
function untilEnd(done: number): number {
  const size = Math.max(SMALLEST, Math.min(2 ** (30 - Math.clz32(done)), LARGEST));
  return size - (done % size);
}

const blocks = new Map<number, Block>(); // by SH degree, shared by all decoders

function blockOf({ degree }: Header): Block {
  const block = blocks.get(degree) ?? new Block(degree);
  blocks.set(degree, block);
  return block;
}

/** LEB128 at an offset, and where it ends; NaN where bytes are missing. */
function number(bytes: Uint8Array, at: number): [number, number] {
  let value = 0;
  for (let i = 0; i < 4; i++) {
    const byte = bytes[at + i];
    if (byte === undefined) return [Number.NaN, at];
    value |= (byte & 127) << (7 * i);
    if (byte < 128) return [value, at + i + 1];
  }
  throw new Error("no number of Gaussians or bytes");
}

function joined(a: Uint8Array, b: Uint8Array): Uint8Array {
  const both = new Uint8Array(a.length + b.length);
  both.set(a);
  both.set(b, a.length);
  return both;
}
