/** Decodes coded streams to the numbers that docs/formats.md says, for comparison. */

import { BASES, type Block, type Harmonics, ROTATIONS } from "../src/core/columns";
import type { Header } from "../src/core/header";
import type { Palette } from "../src/core/palette";
import type { Sink } from "../src/core/stream";

/** The Gaussians of a level, in right, up, back. */
export interface Gaussians {
  readonly count: number;
  readonly means: Float32Array; // [count, 3]
  readonly quats: Float32Array; // [count, 4], w x y z
  readonly logScales: Float32Array; // [count, 3]
  readonly opacities: Float32Array;
  readonly seconds: Float32Array;
  readonly earlier: Float32Array; // second opacities of Gaussians of the levels before it
  readonly sh0: Float32Array; // [count, 3]
  readonly shN: Float32Array; // [count, K, 3]
}

/** A level is decoded to floats. */
export class Floats implements Sink<Gaussians> {
  private header: Header | null = null;
  private rows: Float32Array | null = null; // [rows, K, 3] of the palette

  begin(header: Header, count: number, deferred: number, palette: Palette | null): Gaussians {
    this.header = header;
    this.rows = palette && new Float32Array(3 * palette.count * (BASES[header.degree] as number));
    palette?.decode((harmonics, start) => this.putHarmonics(this.rows as Float32Array, harmonics, start));
    const floats = (each: number) => new Float32Array(each * count);
    return {
      count,
      means: floats(3),
      quats: floats(4),
      logScales: floats(3),
      opacities: floats(1),
      seconds: floats(1),
      earlier: new Float32Array(deferred),
      sh0: floats(3),
      shN: floats(3 * (BASES[header.degree] as number)),
    };
  }

  putSeconds(level: Gaussians, block: Block, start: number, count: number): void {
    for (let i = 0; i < count; i++) level.earlier[start + i] = this.opacity(block.seconds[i] as number);
  }

  private opacity(steps: number): number {
    const { opacityStep } = this.header as Header;
    return Math.max(0.25, Math.min(steps * opacityStep, 254.75)) / 255;
  }

  put(level: Gaussians, block: Block, start: number, count: number): void {
    const header = this.header as Header;
    const at = (column: Int32Array, i: number) => column[i] as number;
    const log = (s: number) => Math.max(-40, Math.min((s + header.scaleOrigin) * header.scaleStep, 40));
    const colour = (c: number) => ((c + header.colourOrigin) * header.colourStep - 127.5) / 38.25;
    for (let i = 0; i < count; i++) {
      const row = start + i;
      const steps = ROTATIONS[at(block.classes, i)] as number;
      level.opacities[row] = this.opacity(at(block.opacities, i));
      level.seconds[row] = this.opacity(at(block.seconds, i));
      let square = 1;
      for (const axis of [0, 1, 2] as const) {
        level.means[3 * row + axis] = header.origin[axis] + header.step * at(block.cells[axis], i);
        level.logScales[3 * row + axis] = log(at(block.scales[axis], i));
        level.sh0[3 * row + axis] = colour(at(block.colours[axis], i));
        const part = (at(block.rotations[axis], i) * Math.SQRT1_2) / steps;
        level.quats[4 * row + 1 + axis] = part;
        square -= part ** 2;
      }
      level.quats[4 * row] = Math.sqrt(Math.max(0, square));
    }
    if (this.rows) this.putRows(level.shN, this.rows, block.entries, start, count);
    else this.putHarmonics(level.shN, block.harmonics, start);
  }

  private putRows(
    out: Float32Array,
    rows: Float32Array,
    entries: Int32Array,
    start: number,
    count: number,
  ): void {
    const each = 3 * (BASES[(this.header as Header).degree] as number);
    for (let i = 0; i < count; i++) {
      const entry = entries[i] as number;
      out.set(rows.subarray(each * entry, each * (entry + 1)), each * (start + i));
    }
  }

  private putHarmonics(out: Float32Array, harmonics: readonly Harmonics[], start: number): void {
    const { shBits, degree } = this.header as Header;
    harmonics.forEach(({ found, rows, places, red, green, blue }, band) => {
      const unit = 2 ** (1 - shBits[band ? 1 : 0]);
      for (let i = 0; i < found; i++) {
        const basis = (BASES[band] as number) + (places[i] as number);
        const first = 3 * ((start + (rows[i] as number)) * (BASES[degree] as number) + basis);
        out.set([unit * (red[i] as number), unit * (green[i] as number), unit * (blue[i] as number)], first);
      }
    });
  }
}
