/** Decodes coded streams to the numbers that docs/formats.md says, for comparison. */

import { BASES, type Block, ROTATIONS } from "../src/core/columns";
import type { Header } from "../src/core/header";
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

  begin(header: Header, count: number, deferred: number): Gaussians {
    this.header = header;
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
    block.harmonics.forEach(({ found, rows, places, red, green, blue }, band) => {
      const unit = 2 ** (1 - header.shBits[band ? 1 : 0]);
      for (let i = 0; i < found; i++) {
        const basis = (BASES[band] as number) + at(places, i);
        const first = 3 * ((start + at(rows, i)) * (BASES[header.degree] as number) + basis);
        level.shN.set([unit * at(red, i), unit * at(green, i), unit * at(blue, i)], first);
      }
    });
  }
}
