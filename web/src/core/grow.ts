/** What belongs together around a splat: what is connected to it and of the colour around it. */

import type { Vec3 } from "../types";
import { axesOf, type Encoding, type Packed, positionOf, scalesOf } from "./pick";

const EDGE = 4; // of a cell, in medians of the splats' largest standard deviation
const EXTENT = 1.5; // standard deviations that a splat fills
const MOST = 4; // points of a splat beside its centre, along an axis in one direction
const FAINT = 25; // in 1/255: fainter splats fill no cells
const SHARED = 0.1; // of a neighbour's colours that count for a cell
const OWN = 2.25; // tolerances that the colour of a single splat may be off: theirs scatter
const CLOSINGS = 2; // rounds in which a cell joins that most of its neighbours are in

const AROUND = Array.from(
  { length: 27 },
  (_, i): Vec3 => [(i % 3) - 1, (Math.floor(i / 3) % 3) - 1, Math.floor(i / 9) - 1],
).filter((to) => to.some((step) => step !== 0));

/**
 * The splats of a label that are connected to one of them and of the colour around it, as a mask by rank.
 *
 * Regions are made of cells that splats fill: large ones reach far, gaps are bridged, and colours are means,
 * as single splats of one surface are lighter and darker.
 *
 * @param tolerance - distance from its colour, in 1 for each of red, green and blue
 * @param among - splats that may be taken, by rank; not 0: yes
 */
export function grow(
  cloud: Packed,
  encoding: Encoding,
  seed: number,
  tolerance: number,
  among?: Uint8Array,
): Uint8Array {
  const { words, count } = cloud;
  const cells = new Cells(cloud, encoding, seed, among);
  const colours = cells.colours();
  const [first = 0, steps] = [cells.home[seed], (tolerance * 255) / (encoding.rgbMax - encoding.rgbMin)];
  const colour = colours.subarray(3 * first, 3 * first + 3);
  const isIn = cells.flood(first, (cell) => distance(colours, 3 * cell, colour) <= steps);
  for (let round = 0; round < CLOSINGS; round++) cells.close(isIn);
  const mask = new Uint8Array(count);
  for (let rank = 0; rank < count; rank++) {
    const cell = cells.home[rank] ?? -1;
    if (cell < 0 || (among && !among[rank])) continue;
    const off = distance(rgbOf(words, rank), 0, colour);
    // where colours meet, means are of both: there a splat's own decides
    if (off <= OWN * steps && (isIn[cell] || (off <= steps && cells.touches(cell, isIn)))) mask[rank] = 1;
  }
  mask[seed] = 1;
  return mask;
}

/** The cells of a grid that splats fill. */
class Cells {
  /** The cell of each splat's centre; -1: none fills it. */
  readonly home: Int32Array;
  private readonly numbers = new Map<number, number>();
  private readonly places: number[] = []; // three each
  private readonly sums: number[] = []; // four each: of opacities, and of colours by opacity
  private readonly around: Int32Array; // its neighbours; -1: not filled
  private readonly edge: number;

  constructor({ words, count }: Packed, encoding: Encoding, seed: number, among?: Uint8Array) {
    const scales = scalesOf(encoding);
    this.edge = EDGE * median(words, count, scales);
    for (let rank = 0; rank < count; rank++) {
      const opacity = (words[4 * rank] as number) >>> 24;
      if ((among && !among[rank]) || (opacity < FAINT && rank !== seed)) continue;
      const rgb = rgbOf(words, rank);
      for (const cell of this.filled(words, rank, scales)) {
        this.sums[4 * cell] = (this.sums[4 * cell] ?? 0) + opacity + 1;
        for (const axis of [0, 1, 2]) {
          const at = 4 * cell + axis + 1;
          this.sums[at] = (this.sums[at] ?? 0) + (opacity + 1) * (rgb[axis] ?? 0);
        }
      }
    }
    this.home = Int32Array.from({ length: count }, (_, rank) => {
      const [x, y, z] = positionOf(words, rank).map((value) => Math.floor(value / this.edge));
      return this.numbers.get(keyOf(x ?? 0, y ?? 0, z ?? 0)) ?? -1;
    });
    this.around = new Int32Array(AROUND.length * this.numbers.size);
    for (let at = 0, i = 0; at < this.places.length; at += 3)
      for (const [x, y, z] of AROUND) {
        const key = keyOf(x + this.place(at), y + this.place(at + 1), z + this.place(at + 2));
        this.around[i++] = this.numbers.get(key) ?? -1;
      }
  }

  /** The mean colour of each cell, and less of its neighbours', in bytes, weighted by opacity. */
  colours(): Float64Array {
    const found = new Float64Array(3 * this.numbers.size);
    for (let cell = 0; cell < this.numbers.size; cell++) {
      const [sum, rgb] = [this.sums.slice(4 * cell, 4 * cell + 4), [0, 1, 2]];
      for (const other of this.neighbours(cell))
        for (let i = 0; i < 4; i++) sum[i] = (sum[i] ?? 0) + SHARED * (this.sums[4 * other + i] ?? 0);
      for (const axis of rgb) found[3 * cell + axis] = (sum[axis + 1] ?? 0) / (sum[0] ?? 1);
    }
    return found;
  }

  /** The cells that are connected to one of them through such that `accepts` takes. */
  flood(first: number, accepts: (cell: number) => boolean): Uint8Array {
    const isIn = new Uint8Array(this.numbers.size);
    isIn[first] = 1;
    const queue = [first];
    for (let next = queue.pop(); next !== undefined; next = queue.pop())
      for (const cell of this.neighbours(next))
        if (!isIn[cell] && accepts(cell)) {
          isIn[cell] = 1;
          queue.push(cell);
        }
    return isIn;
  }

  /** Adds the cells that most of their neighbours are in. */
  close(isIn: Uint8Array): void {
    const before = isIn.slice();
    for (let cell = 0; cell < before.length; cell++) {
      const all = this.neighbours(cell);
      if (all.filter((other) => before[other]).length > all.length / 2) isIn[cell] = 1;
    }
  }

  /** Whether a cell has a neighbour among some. */
  touches(cell: number, isIn: Uint8Array): boolean {
    return this.neighbours(cell).some((other) => isIn[other]);
  }

  private place(at: number): number {
    return this.places[at] as number;
  }

  private neighbours(cell: number): number[] {
    const found: number[] = [];
    for (let i = AROUND.length * cell; i < AROUND.length * (cell + 1); i++) {
      const other = this.around[i] as number;
      if (other >= 0) found.push(other);
    }
    return found;
  }

  /** The cells that a splat fills, along its two largest axes; those that are new get a number. */
  private filled(words: Uint32Array, rank: number, scales: Float64Array): Set<number> {
    const [centre, [a, b]] = [positionOf(words, rank), axesOf(words, rank, scales)];
    const [stepsA, stepsB] = [this.stepsOf(a), this.stepsOf(b)];
    const found = new Set<number>();
    for (let i = -stepsA; i <= stepsA; i++)
      for (let j = -stepsB; j <= stepsB; j++) {
        const [u, v] = [(EXTENT * i) / Math.max(stepsA, 1), (EXTENT * j) / Math.max(stepsB, 1)];
        const place = centre.map((value, axis) =>
          Math.floor((value + u * (a[axis] ?? 0) + v * (b[axis] ?? 0)) / this.edge),
        );
        found.add(this.numberOf(place));
      }
    return found;
  }

  private stepsOf(axis: readonly number[]): number {
    return Math.min(Math.floor((EXTENT * Math.hypot(...axis)) / this.edge), MOST);
  }

  private numberOf(place: readonly number[]): number {
    const [x = 0, y = 0, z = 0] = place;
    const key = keyOf(x, y, z);
    const known = this.numbers.get(key);
    if (known !== undefined) return known;
    this.places.push(x, y, z);
    this.numbers.set(key, this.numbers.size);
    return this.numbers.size - 1;
  }
}

const keyOf = (x: number, y: number, z: number): number =>
  (x & 0xffff) * 2 ** 32 + (y & 0xffff) * 2 ** 16 + (z & 0xffff);

function rgbOf(words: Uint32Array, rank: number): readonly number[] {
  const word = words[4 * rank] as number;
  return [word & 255, (word >>> 8) & 255, (word >>> 16) & 255];
}

function distance(colours: ArrayLike<number>, at: number, colour: ArrayLike<number>): number {
  let sum = 0;
  for (let i = 0; i < 3; i++) sum += ((colours[at + i] ?? 0) - (colour[i] ?? 0)) ** 2;
  return Math.sqrt(sum);
}

function median(words: Uint32Array, count: number, scales: Float64Array): number {
  const largest = Float64Array.from({ length: count }, (_, rank) => {
    const sizes = words[4 * rank + 3] as number;
    return scales[Math.max(sizes & 255, (sizes >>> 8) & 255, (sizes >>> 16) & 255)] as number;
  });
  return largest.sort()[count >> 1] || 1e-6;
}
