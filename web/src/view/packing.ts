/** Gaussians of coded streams in Spark's packed encoding. */

import { type Block, type Harmonics, ROTATIONS } from "../core/columns";
import type { Header } from "../core/header";
import type { Palette } from "../core/palette";
import type { Sink } from "../core/stream";

export const HARMONICS = ["sh1", "sh2", "sh3"] as const;
export const WORDS = { sh1: 2, sh2: 4, sh3: 4 } as const; // uint32 words per splat

/** Streams do not limit colours, and these hold hardly any beyond. Their own steps are 1.5 times as wide as these. */
export const ENCODING = {
  rgbMin: -0.5,
  rgbMax: 2,
  lnScaleMin: -12,
  lnScaleMax: 9,
  sh1Max: 1,
  sh2Max: 1,
  sh3Max: 1,
  lodOpacity: false,
};

/** A decoded increment in main memory: Spark's packed encoding, trimmed to `count` splats. */
export interface Part {
  readonly count: number;
  readonly splats: Uint32Array; // [count, 4]
  readonly harmonics: ReadonlyMap<(typeof HARMONICS)[number], Uint32Array>;
  readonly opacities: Uint8Array | null; // [count, 2] in 1/255: the first and the second one, if there are two
  readonly earlier?: Uint8Array; // second opacities of the splats before it, which have come with it
}

const SH_C0 = 0.28209479177387814;
const LONGEST_LOG = 40;
const NO_SCALE = -30; // logarithm below which Spark takes a scale as 0
const BITS = [7, 8, 6] as const; // of a coefficient, by degree
const REACH = 128; // steps on both sides of 0 that tables hold

/** The byte of a rotation's angle by class and the sum of the squares of its x, y, z. */
const angles = ROTATIONS.map((steps) =>
  Uint8Array.from({ length: 3 * steps * steps + 1 }, (_, square) => {
    const w = Math.sqrt(Math.max(0, 1 - square / (2 * steps * steps)));
    return Math.round(2 * Math.acos(w) * (255 / Math.PI));
  }),
);

/** Values of a function for small integers from a table, for others as they come. */
class Lookup {
  private readonly table: Uint8Array;
  constructor(private readonly of: (value: number) => number) {
    this.table = new Uint8Array(2 * REACH);
    for (let i = 0; i < 2 * REACH; i++) this.table[i] = of(i - REACH);
  }
  at(value: number): number {
    const i = value + REACH;
    return i >= 0 && i < 2 * REACH ? (this.table[i] as number) : this.of(value);
  }
}

/** Writes levels as parts. */
export class Packing implements Sink<Part> {
  private header: Header | null = null;
  private scale = new Lookup(() => 0);
  private colour = this.scale;
  private alpha = new Uint8Array(0); // in 1/255, by opacity
  private coefficients: readonly Lookup[] = [];
  private rows: readonly Uint32Array[] = []; // words of the palette, by degree

  begin(header: Header, count: number, deferred: number, palette: Palette | null): Part {
    if (header !== this.header) this.prepare(header, palette);
    const harmonics = HARMONICS.slice(0, header.degree).map(
      (key) => [key, new Uint32Array(count * WORDS[key])] as const,
    );
    const opacities = header.twoOpacities ? new Uint8Array(2 * count) : null;
    const splats = new Uint32Array(4 * count);
    const part = { count, splats, harmonics: new Map(harmonics), opacities };
    return deferred ? { ...part, earlier: new Uint8Array(deferred) } : part;
  }

  put(part: Part, block: Block, start: number, count: number): void {
    if (part.opacities) this.putOpacities(part.opacities, block, start, count);
    this.putColours(part.splats, block, start, count);
    this.putPositions(part.splats, block, start, count);
    this.putShapes(part.splats, block, start, count);
    const words = [...part.harmonics.values()];
    if (this.rows.length) putRows(words, this.rows, block.entries, start, count);
    else this.putHarmonics(words, block.harmonics, start);
  }

  putSeconds(part: Part, { seconds }: Block, start: number, count: number): void {
    const out = part.earlier as Uint8Array;
    for (let i = 0; i < count; i++) out[start + i] = this.alpha[seconds[i] as number] as number;
  }

  private putHarmonics(words: readonly Uint32Array[], harmonics: readonly Harmonics[], start: number): void {
    harmonics.forEach((own, i) => {
      const [row, bits] = [WORDS[HARMONICS[i] as "sh1"], BITS[i] as number];
      putHarmonics(words[i] as Uint32Array, row, bits, this.coefficients[i] as Lookup, own, start);
    });
  }

  /** The words of a palette, which is decoded once. */
  private rowsOf(palette: Palette): readonly Uint32Array[] {
    const known = rowsOfPalettes.get(palette);
    if (known) return known;
    const words = HARMONICS.slice(0, palette.degree).map(
      (key) => new Uint32Array(palette.count * WORDS[key]),
    );
    palette.decode((harmonics, start) => this.putHarmonics(words, harmonics, start));
    rowsOfPalettes.set(palette, words);
    return words;
  }

  private prepare(header: Header, palette: Palette | null): void {
    this.header = header;
    const { scaleOrigin, scaleStep, colourOrigin, colourStep, shBits, opacityStep } = header;
    this.alpha = Uint8Array.from({ length: 256 }, (_, opacity) => Math.min(opacity * opacityStep, 255));
    this.scale = new Lookup((steps) => scaleByte((steps + scaleOrigin) * scaleStep));
    this.colour = new Lookup((steps) => colourByte(((steps + colourOrigin) * colourStep - 127.5) / 38.25));
    this.coefficients = BITS.slice(0, header.degree).map((bits, i) => {
      const [step, most] = [2 ** (1 - shBits[i ? 1 : 0]), 2 ** (bits - 1) - 1];
      const mask = 2 ** bits - 1;
      return new Lookup((value) => Math.round(Math.max(-most, Math.min(most, value * step * most))) & mask);
    });
    this.rows = palette ? this.rowsOf(palette) : [];
  }

  private putOpacities(out: Uint8Array, block: Block, start: number, count: number): void {
    const { opacities, seconds } = block;
    const { alpha } = this;
    for (let i = 0, at = 2 * start; i < count; i++, at += 2) {
      out[at] = alpha[opacities[i] as number] as number;
      out[at + 1] = alpha[seconds[i] as number] as number;
    }
  }

  private putColours(splats: Uint32Array, block: Block, start: number, count: number): void {
    const [red, green, blue] = block.colours;
    const { opacities } = block;
    const { colour, alpha } = this;
    for (let i = 0, at = 4 * start; i < count; i++, at += 4) {
      splats[at] =
        colour.at(red[i] as number) |
        (colour.at(green[i] as number) << 8) |
        (colour.at(blue[i] as number) << 16) |
        ((alpha[opacities[i] as number] as number) << 24);
    }
  }

  private putPositions(splats: Uint32Array, block: Block, start: number, count: number): void {
    const [xs, ys, zs] = block.cells;
    const { origin, step } = this.header as Header;
    const [x, y, z] = origin;
    for (let i = 0, at = 4 * start + 1; i < count; i++, at += 4) {
      splats[at] = half(x + step * (xs[i] as number)) | (half(y + step * (ys[i] as number)) << 16);
      splats[at + 1] = half(z + step * (zs[i] as number));
    }
  }

  /** Rotations as Spark's encoder has them: the axis by an octahedron, the angle from 0 to pi. */
  private putShapes(splats: Uint32Array, block: Block, start: number, count: number): void {
    const [xs, ys, zs] = block.rotations;
    const [largest, middle, smallest] = block.scales;
    const { classes } = block;
    const { scale } = this;
    for (let i = 0, at = 4 * start + 2; i < count; i++, at += 4) {
      const x = xs[i] as number;
      const y = ys[i] as number;
      const z = zs[i] as number;
      const [ax, ay] = [Math.abs(x), Math.abs(y)];
      const sum = ax + ay + Math.abs(z);
      let u = 255;
      let v = 128;
      if (sum) {
        const unit = 127.5 / sum;
        let [px, py] = [x * unit, y * unit];
        if (z < 0) {
          px = x < 0 ? ay * unit - 127.5 : 127.5 - ay * unit;
          py = y < 0 ? ax * unit - 127.5 : 127.5 - ax * unit;
        }
        u = (px + 128) | 0;
        v = (py + 128) | 0;
      }
      const angle = (angles[classes[i] as number] as Uint8Array)[x * x + y * y + z * z] as number;
      splats[at] = (splats[at] as number) | (u << 16) | (v << 24);
      splats[at + 1] =
        scale.at(largest[i] as number) |
        (scale.at(middle[i] as number) << 8) |
        (scale.at(smallest[i] as number) << 16) |
        (angle << 24);
    }
  }
}

const rowsOfPalettes = new WeakMap<Palette, readonly Uint32Array[]>();

/** Copies rows of a palette to words, degree by degree. */
function putRows(
  words: readonly Uint32Array[],
  rows: readonly Uint32Array[],
  entries: Int32Array,
  start: number,
  count: number,
): void {
  words.forEach((out, i) => {
    const from = rows[i] as Uint32Array;
    const row = WORDS[HARMONICS[i] as "sh1"];
    for (let k = 0, at = row * start; k < count; k++) {
      const first = row * (entries[k] as number);
      for (let j = 0; j < row; j++) out[at++] = from[first + j] as number;
    }
  });
}

/** Adds coefficients of `bits` bits, r g b, coefficient after coefficient, to words that are 0. */
function putHarmonics(
  words: Uint32Array,
  row: number, // words of a splat
  bits: number,
  lookup: Lookup,
  { found, rows, places, red, green, blue }: Harmonics,
  start: number,
): void {
  for (let i = 0; i < found; i++) {
    const value =
      lookup.at(red[i] as number) |
      (lookup.at(green[i] as number) << bits) |
      (lookup.at(blue[i] as number) << (2 * bits));
    const first = 3 * bits * (places[i] as number);
    const at = row * (start + (rows[i] as number)) + (first >> 5);
    const shift = first & 31;
    words[at] = (words[at] as number) | (value << shift);
    if (shift + 3 * bits > 32) words[at + 1] = value >>> (32 - shift); // nothing is there yet
  }
}

function scaleByte(log: number): number {
  const within = Math.max(-LONGEST_LOG, Math.min(log, LONGEST_LOG));
  if (within < NO_SCALE) return 0;
  const { lnScaleMin, lnScaleMax } = ENCODING;
  const steps = Math.round(((within - lnScaleMin) * 254) / (lnScaleMax - lnScaleMin)) + 1;
  return Math.max(1, Math.min(steps, 255));
}

function colourByte(sh0: number): number {
  const { rgbMin, rgbMax } = ENCODING;
  const share = (sh0 * SH_C0 + 0.5 - rgbMin) / (rgbMax - rgbMin);
  return Math.max(0, Math.min(255, Math.round(share * 255)));
}

const float = new Float32Array(1);
const bitsOfFloat = new Uint32Array(float.buffer);

/** The nearest number of 16 bits. */
function half(value: number): number {
  float[0] = value;
  const bits = bitsOfFloat[0] as number;
  const size = bits & 0x7fffffff;
  const sign = (bits >>> 16) & 0x8000;
  if (size >= 0x38800000 && size < 0x477ff000) {
    return sign | ((size - 0x38000000 + 0xfff + ((size >>> 13) & 1)) >>> 13);
  }
  return sign | (size < 0x38800000 ? Math.round(Math.abs(value) * 2 ** 24) : 0x7c00);
}
