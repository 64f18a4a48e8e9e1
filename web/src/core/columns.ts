/** The columns of a coded stream, decoded to integers. docs/formats.md specifies them. */

import type { Header } from "./header";
import { type Reader, Table } from "./rans";

export const LARGEST = 2048; // Gaussians of a block
export const BASES = [0, 3, 8, 15] as const; // SH coefficients beyond the constant one, by degree
export const ROTATIONS = [4, 6, 8, 11, 16, 23, 32, 45, 64, 90, 127] as const; // steps in sqrt(1/2), by class
const ESCAPE_BITS = 20;
const POSITION_BITS = 51;
const PEAK = 512; // count of the likeliest symbol of a new table
const CLASSES = 4; // of first opacities: rows of the table of second ones
const FLAT = 128; // of each symbol of a new table where none is likelier
const ENTRY_BITS = 16; // of the number of a palette's row
const LIKELY = 64; // of an opacity that is not the largest

const peak = (likeliest: number, half: number) => (symbol: number) =>
  Math.max(1, PEAK >> Math.min(31, Math.floor(Math.abs(symbol - likeliest) / half)));

const column = () => new Int32Array(LARGEST);
const triple = (): Triple => [column(), column(), column()];

type Triple = readonly [Int32Array, Int32Array, Int32Array];

/** Up to 2048 Gaussians as integers, a column for each attribute. */
export class Block {
  readonly cells = triple(); // x, y, z of positions
  readonly opacities = column(); // the first ones, or the only ones
  readonly seconds = column(); // the same where there is one
  readonly scales = triple(); // the largest, the middle, the smallest
  readonly classes = column(); // of rotations
  readonly rotations = triple(); // x, y, z
  readonly colours = triple(); // r, g, b
  readonly harmonics: readonly Harmonics[];
  readonly entries = column(); // rows of the palette, if there is one; `harmonics` are then empty

  constructor(degree: number) {
    this.harmonics = Array.from({ length: degree }, (_, i) => new Harmonics(2 * i + 3));
  }
}

/** The coefficients of one degree that are not 0 in all colours. */
export class Harmonics {
  found = 0;
  readonly rows: Int32Array; // of the block
  readonly places: Int32Array; // in the degree
  readonly red: Int32Array;
  readonly green: Int32Array;
  readonly blue: Int32Array;

  constructor(bases: number) {
    const values = () => new Int32Array(LARGEST * bases);
    [this.rows, this.places, this.red, this.green, this.blue] = [
      values(),
      values(),
      values(),
      values(),
      values(),
    ];
  }
}

const SPREAD = new Uint16Array(4096); // every third bit of 12: of x in the lowest 4 bits, then of y, then of z
for (let bits = 0; bits < SPREAD.length; bits++) {
  for (let i = 0; i < 12; i++) {
    if (bits & (1 << i)) SPREAD[bits] = (SPREAD[bits] as number) | (1 << (4 * (i % 3) + Math.floor(i / 3)));
  }
}

const widths = column();
const wide = new Float64Array(LARGEST);
const contexts = new Int32Array(LARGEST * 7);
const masks = column();
const lower = column(); // coefficients of lower degrees that are not 0

type Tables = readonly [masks: Table, green: Table, red: Table, blue: Table];

function tablesOf(degree: number): Tables {
  const values = (rows: number) => new Table(rows, 32, peak(15, 0.5));
  const rows = (BASES[degree - 1] as number) + 1;
  const ofMasks = new Table(rows, 1 << (2 * degree + 1), (mask, row) =>
    Math.max(1, PEAK >> (Math.max(4 - row, 2) * ones(mask))),
  );
  return [ofMasks, values(1), values(7), values(15)];
}

/** What every stream begins with. */
const NEW = {
  gap: new Table(1, POSITION_BITS + 1, peak(18, 3)),
  entry: new Table(1, ENTRY_BITS + 1, peak(ENTRY_BITS - 1, 1)),
  scale: new Table(3, 128, (symbol, row) => (row ? peak(5, 5) : peak(64, 5))(symbol)),
  rotation: new Table(11, 255, (symbol, row) =>
    Math.abs(symbol - 127) <= (ROTATIONS[row] as number) ? FLAT : 0,
  ),
  colour: new Table(3, 160, (symbol, row) => (row ? peak(80, 5) : peak(80, 10))(symbol)),
  bands: [tablesOf(1), tablesOf(2), tablesOf(3)],
};

/** Decodes columns of Gaussians, and learns from them at the end of a block. */
export class Columns {
  private readonly gap = NEW.gap.copy();
  private readonly opacity: Table;
  private readonly second: Table;
  private readonly largest: number; // opacity
  private readonly scale = NEW.scale.copy();
  private readonly rotation = NEW.rotation.copy();
  private readonly colour = NEW.colour.copy();
  private readonly bands: readonly Tables[];
  private readonly entry = NEW.entry.copy();
  private readonly tables: Table[];

  /** @param rows - of the palette, 0: none */
  constructor(
    private readonly header: Header,
    private readonly rows: number,
  ) {
    const [least, most] = [header.twoOpacities ? 0 : 1, Math.ceil(255 / header.opacityStep)];
    const flat = (symbol: number) => (symbol >= least && symbol <= most ? LIKELY : 0);
    const opaque = (symbol: number) => (symbol === most ? PEAK : flat(symbol));
    this.opacity = new Table(1, 256, opaque);
    this.second = new Table(CLASSES, 256, (symbol, row) => (row < CLASSES - 1 ? flat : opaque)(symbol));
    this.largest = most;
    this.bands = rows ? [] : newBands(header.degree);
    const { gap, second, scale, rotation, colour, entry, bands } = this;
    this.tables = [gap, this.opacity, second, scale, rotation, colour, entry, ...bands.flat()];
  }

  /**
   * Decodes `count` Gaussians into the first rows of a block; the last position, as Morton code.
   *
   * @param before - the position before them in the level
   * @param two - whether they have two opacities
   */
  decode(reader: Reader, block: Block, count: number, before: number, two: boolean): number {
    const last = this.decodePositions(reader, block.cells, count, before);
    this.decodeOpacities(reader, block, count, two);
    this.decodeScales(reader, block, count);
    for (const column of block.rotations) reader.ofRows(this.rotation, block.classes, 127, column, count);
    this.decodeColours(reader, block.colours, count);
    if (this.rows) this.decodeEntries(reader, block.entries, count);
    else decodeBands(reader, this.bands, block.harmonics, count);
    return last;
  }

  endBlock(): void {
    for (const table of this.tables) table.endBlock();
  }

  private decodePositions(reader: Reader, [x, y, z]: Triple, count: number, before: number): number {
    readLengths(reader, this.gap, count);
    let code = before;
    for (let i = 0; i < count; i++) {
      code += wide[i] as number;
      if (code >= 2 ** POSITION_BITS) throw new Error("a position outside the grid");
      const high = Math.floor(code * 2 ** -24);
      const low = code - high * 2 ** 24;
      const a = SPREAD[low & 4095] as number;
      const b = SPREAD[low >> 12] as number;
      const c = SPREAD[high & 4095] as number;
      const d = SPREAD[(high >> 12) & 4095] as number;
      const e = SPREAD[high >> 24] as number;
      x[i] = (a & 15) | ((b & 15) << 4) | ((c & 15) << 8) | ((d & 15) << 12) | ((e & 15) << 16);
      y[i] = ((a >> 4) & 15) | (b & 240) | ((c & 240) << 4) | ((d & 240) << 8) | ((e & 240) << 12);
      z[i] = (a >> 8) | ((b >> 8) << 4) | ((c >> 8) << 8) | ((d >> 8) << 12) | ((e >> 8) << 16);
    }
    return code;
  }

  private decodeEntries(reader: Reader, entries: Int32Array, count: number): void {
    readLengths(reader, this.entry, count);
    for (let i = 0; i < count; i++) {
      const entry = wide[i] as number;
      if (entry >= this.rows) throw new Error("a row that the palette does not have");
      entries[i] = entry;
    }
  }

  private decodeOpacities(reader: Reader, block: Block, count: number, two: boolean): void {
    reader.ofRow(this.opacity, 0, 0, block.opacities, count);
    if (two) this.decodeSeconds(reader, block, count);
    else block.seconds.set(block.opacities.subarray(0, count));
  }

  /** Decodes second opacities of Gaussians whose first ones are in the first rows of a block. */
  decodeSeconds(reader: Reader, { opacities, seconds }: Block, count: number): void {
    for (let i = 0; i < count; i++) {
      contexts[i] = Math.floor(((opacities[i] as number) * CLASSES) / (this.largest + 1));
    }
    reader.ofRows(this.second, contexts, 0, seconds, count);
  }

  private decodeScales(reader: Reader, block: Block, count: number): void {
    const [largest, middle, smallest] = block.scales;
    const { classes } = block;
    const { rotationOrigin, spread } = this.header;
    readValues(reader, this.scale, 0, 64, largest, count);
    readValues(reader, this.scale, 1, 0, middle, count);
    readValues(reader, this.scale, 2, 0, smallest, count);
    for (let i = 0; i < count; i++) {
      const most = largest[i] as number;
      const second = most - (middle[i] as number);
      const least = second - (smallest[i] as number);
      middle[i] = second;
      smallest[i] = least;
      const size = Math.floor((2 * most - least - rotationOrigin) / spread);
      classes[i] = Math.max(0, Math.min(size, ROTATIONS.length - 1));
    }
  }

  private decodeColours(reader: Reader, [red, green, blue]: Triple, count: number): void {
    readValues(reader, this.colour, 0, 80, green, count);
    readValues(reader, this.colour, 1, 80, red, count);
    readValues(reader, this.colour, 2, 80, blue, count);
    for (let i = 0; i < count; i++) {
      const g = green[i] as number;
      red[i] = (red[i] as number) + g;
      blue[i] = (blue[i] as number) + g;
    }
  }
}

/** Decodes numbers from 0 on into `wide`: how many bits they have, then those below the highest. */
function readLengths(reader: Reader, table: Table, count: number): void {
  reader.ofRow(table, 0, 1, widths, count);
  for (let i = 0; i < count; i++) wide[i] = (widths[i] as number) < 0 ? 0 : 1;
  reader.bits(widths, wide, count);
}

/** The tables that harmonics begin with, by degree. */
export const newBands = (degree: number): Tables[] =>
  NEW.bands.slice(0, degree).map(([masks, green, red, blue]) => {
    return [masks.copy(), green.copy(), red.copy(), blue.copy()];
  });

/** Decodes `count` rows of harmonics. */
export function decodeBands(
  reader: Reader,
  bands: readonly Tables[],
  harmonics: readonly Harmonics[],
  count: number,
): void {
  lower.fill(0, 0, count);
  bands.forEach((tables, i) => {
    decodeHarmonics(reader, tables, harmonics[i] as Harmonics, count);
  });
}

/** Adds to `lower` what is not 0 of this degree. */
function decodeHarmonics(
  reader: Reader,
  [ofMasks, ofGreen, ofRed, ofBlue]: Tables,
  harmonics: Harmonics,
  count: number,
): void {
  const { rows, places, red, green, blue } = harmonics;
  reader.ofRows(ofMasks, lower, 0, masks, count);
  let found = 0;
  for (let i = 0; i < count; i++) {
    const earlier = found;
    for (let mask = masks[i] as number; mask; mask &= mask - 1) {
      rows[found] = i;
      places[found++] = 31 - Math.clz32(mask & -mask);
    }
    lower[i] = (lower[i] as number) + found - earlier;
  }
  harmonics.found = found;
  readValues(reader, ofGreen, 0, 15, green, found);
  for (let i = 0; i < found; i++) {
    const g = green[i] as number;
    contexts[i] = g < -3 ? 0 : g > 3 ? 6 : g + 3;
  }
  readValues(reader, ofRed, contexts, 15, red, found);
  for (let i = 0; i < found; i++) {
    const g = green[i] as number;
    const r = red[i] as number;
    contexts[i] = 3 * (g < -2 ? 0 : g > 2 ? 4 : g + 2) + (r < -1 ? 0 : r > 1 ? 2 : r + 1);
    red[i] = g + r;
  }
  readValues(reader, ofBlue, contexts, 15, blue, found);
  for (let i = 0; i < found; i++) blue[i] = (blue[i] as number) + (green[i] as number);
}

/** Values around the symbol `zero` of a table, whose last symbol is an escape. */
function readValues(
  reader: Reader,
  table: Table,
  row: number | Int32Array,
  zero: number,
  out: Int32Array,
  count: number,
): void {
  const escapes =
    typeof row === "number"
      ? reader.ofRow(table, row, zero, out, count)
      : reader.ofRows(table, row, zero, out, count);
  if (!escapes) return;
  const rare: number[] = [];
  for (let i = 0; i < count; i++) if (out[i] === table.symbols - 1 - zero) rare.push(i);
  const values = new Float64Array(rare.length);
  reader.bits(new Int32Array(rare.length).fill(ESCAPE_BITS), values, rare.length);
  rare.forEach((i, k) => {
    out[i] = (values[k] as number) - 2 ** (ESCAPE_BITS - 1);
  });
}

function ones(mask: number): number {
  let count = 0;
  for (let left = mask; left; left >>= 1) count += left & 1;
  return count;
}
