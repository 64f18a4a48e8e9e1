/** Palettes of coded streams: rows of harmonics that many Gaussians share. docs/formats.md specifies them. */

import { Block, decodeBands, type Harmonics, LARGEST, newBands } from "./columns";
import type { Header } from "./header";
import { Reader } from "./rans";

const HEADER_BYTES = 16;
const MAGIC = 0x53475350;
const VERSION = 3;
const MOST = 65_536; // rows
const PER_BYTE = 128; // rows in a byte, at most

/** A palette that is decoded when its rows are asked for. */
export class Palette {
  readonly degree: number;
  readonly shBits: readonly [number, number];
  readonly count: number; // rows
  private readonly payload: Uint8Array;

  /** @param bytes - all of it; throws for another format */
  constructor(bytes: Uint8Array) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    if (bytes.length < HEADER_BYTES || view.getUint32(0) !== MAGIC) throw new Error("not a palette");
    if (view.getUint8(4) !== VERSION) throw new Error("a palette of another version");
    this.degree = view.getUint8(5);
    this.shBits = [view.getUint8(6), view.getUint8(7)];
    this.count = view.getUint32(8, true);
    const size = view.getUint32(12, true);
    const bits = this.shBits.every((n) => n >= 1 && n <= 8);
    if (!bits || this.degree < 1 || this.degree > 3 || bytes.length !== HEADER_BYTES + size) {
      throw new Error("a palette with an impossible header");
    }
    if (!this.count || this.count > Math.min(MOST, PER_BYTE * size)) {
      throw new Error("a palette with more rows than fit");
    }
    this.payload = bytes.subarray(HEADER_BYTES);
  }

  /** Throws unless a stream's harmonics can be rows of it. */
  check({ degree, shBits }: Header): void {
    if (degree !== this.degree || shBits.join() !== this.shBits.join()) {
      throw new Error("a palette of other harmonics");
    }
  }

  /** Decodes it: calls back with the harmonics, by degree, of the rows from `start` on. Throws for damage. */
  decode(put: (harmonics: readonly Harmonics[], start: number) => void): void {
    const { harmonics } = new Block(this.degree);
    const reader = new Reader(this.payload);
    const bands = newBands(this.degree);
    for (let start = 0; start < this.count; start += LARGEST) {
      decodeBands(reader, bands, harmonics, Math.min(LARGEST, this.count - start));
      for (const table of bands.flat()) table.endBlock();
      put(harmonics, start);
    }
    reader.finish();
  }
}
