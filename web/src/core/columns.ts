/** The columns of a coded stream, decoded to Gaussians. docs/formats.md specifies them. */

import { type Reader, Table } from "./rans";
import type { Gaussians, Header } from "./stream";

export const LARGEST = 2048; // Gaussians of a block
export const BASES = [0, 3, 8, 15] as const; // SH coefficients beyond the constant one, by degree
const ROTATIONS = [4, 6, 8, 11, 16, 23, 32, 45, 64, 90, 127] as const;
const STEPS = Float64Array.from(ROTATIONS, (steps) => Math.SQRT1_2 / steps);
const LONGEST_LOG = 40;
const ESCAPE_BITS = 20;
const POSITION_BITS = 51;
const PEAK = 512; // count of the likeliest symbol of a new table
const FLAT = 128; // of each symbol of a new table where none is likelier

const peak = (likeliest: number, half: number) => (symbol: number) =>
  Math.max(1, PEAK >> Math.min(31, Math.floor(Math.abs(symbol - likeliest) / half)));

const column = () => new Int32Array(LARGEST);

/** Decodes columns of Gaussians, and learns from them at the end of a block. */
export class Columns {
  private readonly gap = new Table(1, POSITION_BITS + 1, peak(24, 4));
  private readonly opacity: Table;
  private readonly scale: Table;
  private readonly rotation = new Table(11, 255, (symbol, row) =>
    Math.abs(symbol - 127) <= (ROTATIONS[row] as number) ? FLAT : 0,
  );
  private readonly colour: Table;
  private readonly bands: Band[] = [];
  private readonly tables: Table[];
  private readonly values = column();
  private readonly first = column();
  private readonly second = column();
  private readonly positions = new Float64Array(LARGEST);

  constructor(private readonly header: Header) {
    const opacities = Math.ceil(255 / header.opacityStep);
    this.opacity = new Table(1, 256, (symbol) => (symbol > 0 && symbol <= opacities ? FLAT : 0));
    const [large, small] = [peak(64, 12), peak(9, 6)];
    this.scale = new Table(3, 128, (symbol, row) => (row ? small : large)(symbol));
    const [green, others] = [peak(80, 12), peak(80, 4)];
    this.colour = new Table(3, 160, (symbol, row) => (row ? others : green)(symbol));
    for (let degree = 1; degree <= header.degree; degree++) this.bands.push(new Band(degree, header));
    this.tables = [this.gap, this.opacity, this.scale, this.rotation, this.colour];
    this.tables.push(...this.bands.flatMap((band) => band.tables));
  }

  /** Decodes `count` Gaussians into rows from `start` on; the last position, as Morton code. */
  decode(reader: Reader, level: Gaussians, start: number, count: number, before: number): number {
    const last = this.decodePositions(reader, level.means, start, count, before);
    const { header, values } = this;
    reader.symbols(this.opacity, 0, 0, values, count);
    for (let i = 0; i < count; i++) {
      level.opacities[start + i] = Math.min((values[i] as number) * header.opacityStep, 254.75) / 255;
    }
    this.decodeScales(reader, level.logScales, start, count);
    this.decodeRotations(reader, level.quats, start, count);
    this.decodeColours(reader, level.sh0, start, count);
    this.first.fill(0);
    for (const band of this.bands) band.decode(reader, level.shN, start, count, this.first);
    return last;
  }

  endBlock(): void {
    for (const table of this.tables) table.endBlock();
  }

  private decodePositions(
    reader: Reader,
    means: Float32Array,
    start: number,
    count: number,
    before: number,
  ): number {
    const { positions, values } = this;
    const { origin, step } = this.header;
    reader.symbols(this.gap, 0, 1, values, count);
    for (let i = 0; i < count; i++) positions[i] = (values[i] as number) < 0 ? 0 : 1;
    reader.bits(values, positions, count);
    let code = before;
    for (let i = 0; i < count; i++) {
      code += positions[i] as number;
      const high = Math.floor(code / 2 ** 24);
      const low = code - high * 2 ** 24;
      for (let axis = 0; axis < 3; axis++) {
        const cell = thirds(low >> axis) | (thirds(high >> axis) << 8);
        means[3 * (start + i) + axis] = (origin[axis] as number) + step * cell;
      }
    }
    if (code >= 2 ** POSITION_BITS) throw new Error("a position outside the grid");
    return code;
  }

  /** Leaves the classes of rotations in `first`. */
  private decodeScales(reader: Reader, logScales: Float32Array, start: number, count: number): void {
    const { values, first, second } = this;
    const { scaleOrigin, scaleStep, rotationOrigin, spread } = this.header;
    const log = (steps: number) =>
      Math.max(-LONGEST_LOG, Math.min((steps + scaleOrigin) * scaleStep, LONGEST_LOG));
    readValues(reader, this.scale, 0, 64, first, count);
    readValues(reader, this.scale, 1, 0, second, count);
    readValues(reader, this.scale, 2, 0, values, count);
    for (let i = 0, at = 3 * start; i < count; i++, at += 3) {
      const largest = first[i] as number;
      const middle = largest - (second[i] as number);
      const smallest = middle - (values[i] as number);
      logScales[at] = log(largest);
      logScales[at + 1] = log(middle);
      logScales[at + 2] = log(smallest);
      const size = Math.floor((2 * largest - smallest - rotationOrigin) / spread);
      first[i] = Math.max(0, Math.min(size, ROTATIONS.length - 1));
    }
  }

  private decodeRotations(reader: Reader, quats: Float32Array, start: number, count: number): void {
    const { values, first } = this;
    for (let axis = 1; axis < 4; axis++) {
      reader.symbols(this.rotation, first, 127, values, count);
      for (let i = 0; i < count; i++) {
        quats[4 * (start + i) + axis] = (values[i] as number) * (STEPS[first[i] as number] as number);
      }
    }
    for (let at = 4 * start; at < 4 * (start + count); at += 4) {
      let square = 1;
      for (let axis = 1; axis < 4; axis++) square -= (quats[at + axis] as number) ** 2;
      quats[at] = square > 0 ? Math.sqrt(square) : 0;
    }
  }

  private decodeColours(reader: Reader, sh0: Float32Array, start: number, count: number): void {
    const { values, first, second } = this;
    const { colourOrigin, colourStep } = this.header;
    readValues(reader, this.colour, 0, 80, first, count);
    readValues(reader, this.colour, 1, 80, second, count);
    readValues(reader, this.colour, 2, 80, values, count);
    const colour = (steps: number) => ((steps + colourOrigin) * colourStep - 127.5) / 38.25;
    for (let i = 0, at = 3 * start; i < count; i++, at += 3) {
      const green = first[i] as number;
      sh0[at] = colour(green + (second[i] as number));
      sh0[at + 1] = colour(green);
      sh0[at + 2] = colour(green + (values[i] as number));
    }
  }
}

/** The harmonics of one degree. */
class Band {
  readonly tables: readonly [Table, Table, Table, Table]; // masks, green, red, blue
  private readonly low: number;
  private readonly bases: number; // of all degrees
  private readonly step: number;
  private readonly masks = column();
  private readonly places: Int32Array; // of the coefficients that are not 0, in shN
  private readonly green: Int32Array;
  private readonly red: Int32Array;
  private readonly blue: Int32Array;
  private readonly contexts: Int32Array;

  constructor(degree: number, header: Header) {
    this.low = BASES[degree - 1] as number;
    this.bases = BASES[header.degree] as number;
    this.step = 2 ** (1 - header.shBits[degree === 1 ? 0 : 1]);
    const bits = 2 * degree + 1;
    const values = (rows: number) => new Table(rows, 32, peak(15, 0.5));
    const masks = new Table(this.low + 1, 1 << bits, (mask) => Math.max(1, PEAK >> (2 * ones(mask))));
    this.tables = [masks, values(1), values(7), values(15)];
    const columns = Array.from({ length: 5 }, () => new Int32Array(LARGEST * bits));
    [this.places, this.green, this.red, this.blue, this.contexts] = columns as [
      Int32Array,
      Int32Array,
      Int32Array,
      Int32Array,
      Int32Array,
    ];
  }

  /** `before`: coefficients of lower degrees that are not 0; this degree's are added. */
  decode(reader: Reader, shN: Float32Array, start: number, count: number, before: Int32Array): void {
    const { places, green, red, blue, contexts, masks, step } = this;
    reader.symbols(this.tables[0], before, 0, masks, count);
    let found = 0;
    for (let i = 0; i < count; i++) {
      let place = 3 * ((start + i) * this.bases + this.low);
      const earlier = found;
      for (let mask = masks[i] as number; mask; mask >>= 1, place += 3) {
        if (mask & 1) places[found++] = place;
      }
      before[i] = (before[i] as number) + found - earlier;
    }
    readValues(reader, this.tables[1], 0, 15, green, found);
    for (let i = 0; i < found; i++) contexts[i] = Math.max(-3, Math.min(green[i] as number, 3)) + 3;
    readValues(reader, this.tables[2], contexts, 15, red, found);
    for (let i = 0; i < found; i++) {
      const [g, r] = [green[i] as number, red[i] as number];
      contexts[i] = 3 * (Math.max(-2, Math.min(g, 2)) + 2) + Math.max(-1, Math.min(r, 1)) + 1;
    }
    readValues(reader, this.tables[3], contexts, 15, blue, found);
    for (let i = 0; i < found; i++) {
      const place = places[i] as number;
      const g = green[i] as number;
      shN[place] = step * (g + (red[i] as number));
      shN[place + 1] = step * g;
      shN[place + 2] = step * (g + (blue[i] as number));
    }
  }
}

/** Values around the symbol `zero` of a table, whose last symbol is an escape. */
function readValues(
  reader: Reader,
  table: Table,
  rows: number | Int32Array,
  zero: number,
  out: Int32Array,
  count: number,
): void {
  if (!reader.symbols(table, rows, zero, out, count)) return;
  const rare: number[] = [];
  for (let i = 0; i < count; i++) if (out[i] === table.symbols - 1 - zero) rare.push(i);
  const wide = new Float64Array(rare.length);
  reader.bits(new Int32Array(rare.length).fill(ESCAPE_BITS), wide, rare.length);
  rare.forEach((i, k) => {
    out[i] = (wide[k] as number) - 2 ** (ESCAPE_BITS - 1);
  });
}

function ones(mask: number): number {
  let count = 0;
  for (let left = mask; left; left >>= 1) count += left & 1;
  return count;
}

/** Every third bit of 27, from the lowest, side by side. */
function thirds(bits: number): number {
  let x = bits & 0x09249249;
  x = (x ^ (x >> 2)) & 0x030c30c3;
  x = (x ^ (x >> 4)) & 0x0300f00f;
  x = (x ^ (x >> 8)) & 0x030000ff;
  return (x ^ (x >> 16)) & 0x3ff;
}
