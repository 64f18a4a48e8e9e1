/** Coded streams against those of the Python package. */

import { describe, expect, test } from "vitest";
import { Palette } from "../../src/core/palette";
import { StreamDecoder } from "../../src/core/stream";
import { Floats, type Gaussians } from "../floats";
import { fuzz } from "../fuzz";
import { bytesOf, fileOf, type Golden, golden, paletteBytesOf, paletteOf } from "../golden";
import { seeded } from "../simulate";

/** What a decoder finds in bytes that arrive in pieces. */
function decoded(bytes: Uint8Array, palette: Palette | null, piece = bytes.length || 1): Gaussians[] {
  const decoder = new StreamDecoder(new Floats(), palette);
  const levels: Gaussians[] = [];
  for (let at = 0; at < bytes.length; at += piece) levels.push(...decoder.push(bytes.slice(at, at + piece)));
  return levels;
}

function together(levels: readonly Gaussians[]): Golden["gaussians"] {
  const all = (pick: (level: Gaussians) => Float32Array) => levels.flatMap((level) => [...pick(level)]);
  return {
    means: all((g) => g.means),
    quats: all((g) => g.quats),
    log_scales: all((g) => g.logScales),
    opacities: all((g) => g.opacities),
    seconds: secondsOf(levels),
    sh0: all((g) => g.sh0),
    shN: all((g) => g.shN),
  };
}

/** Second opacities of all levels, those that have come with later ones in their places. */
function secondsOf(levels: readonly Gaussians[]): number[] {
  const found: number[] = [];
  for (const { earlier, seconds } of levels) {
    found.splice(found.length - earlier.length, earlier.length, ...earlier);
    found.push(...seconds);
  }
  return found;
}

describe.each(golden)("$name", (one) => {
  test("is decoded to what Python decodes it to", () => {
    const found = together(decoded(bytesOf(one), paletteOf(one)));
    for (const [name, values] of Object.entries(one.gaussians)) {
      const mine = found[name as keyof typeof found];
      expect(mine?.length, name).toBe(values.length);
      const off = values.map((v, i) => Math.abs(v - (mine?.[i] ?? Number.NaN)) / Math.max(1, Math.abs(v)));
      expect(Math.max(0, ...off), name).toBeLessThan(1e-6);
    }
  });

  test.each([1, 7, 100])("is decoded as it arrives, %i bytes at a time", (piece) => {
    const palette = paletteOf(one);
    expect(decoded(bytesOf(one), palette, piece)).toEqual(decoded(bytesOf(one), palette));
  });

  test("gives a level as soon as its last byte is there", () => {
    const bytes = bytesOf(one);
    const decoder = new StreamDecoder(new Floats(), paletteOf(one));
    let [at, size] = [0, 0];
    one.ends.forEach((end, level) => {
      expect(decoder.push(bytes.slice(at, end - 1))).toEqual([]);
      const levels = decoder.push(bytes.slice(end - 1, end));
      at = end;
      size += levels.reduce((sum, { count }) => sum + count, 0);
      expect(levels.length).toBe(1);
      expect(size).toBe(one.sizes[level]);
    });
  });

  test("refuses bytes after the last level", () => {
    expect(() => decoded(Uint8Array.of(...bytesOf(one), 0), paletteOf(one))).toThrow("after the last level");
  });
});

test.each([
  [0, 1, "not a sagesplat-stream"],
  [4, 2, "another version"],
  [4, 4, "another version"],
  [5, 8, "unknown flags"],
  [5, 4, "impossible header"],
  [6, 4, "impossible header"],
  [7, 0, "impossible header"],
  [9, 9, "impossible header"],
  [27, 0x7f, "impossible header"],
])("refuses a header with byte %i set to %i", (at, value, words) => {
  const bytes = bytesOf(golden[0] as Golden);
  bytes[at] = value;
  expect(() => decoded(bytes, null)).toThrow(words);
});

const given = golden.filter(({ palette }) => palette);

test.each([
  [0, 1, "not a palette"],
  [4, 2, "another version"],
  [5, 0, "impossible header"],
  [6, 9, "impossible header"],
  [8, 0, "more rows than fit"],
  [10, 2, "more rows than fit"],
  [12, 1, "impossible header"],
])("refuses a palette with byte %i set to %i", (at, value, words) => {
  const bytes = paletteBytesOf(given[0] as Golden) as Uint8Array;
  bytes[at] = value;
  expect(() => new Palette(bytes)).toThrow(words);
});

test("a stream needs the palette of its file, with all rows that it names", () => {
  const [one, other] = given as [Golden, Golden];
  expect(() => decoded(bytesOf(one), null)).toThrow("no palette");
  expect(() => decoded(bytesOf(one), paletteOf(other))).toThrow("a palette of other harmonics");
  const short = Object.assign(new Palette(paletteBytesOf(one) as Uint8Array), { count: 1, decode: () => {} });
  expect(() => decoded(bytesOf(one), short)).toThrow("a row that the palette does not have");
  const bytes = paletteBytesOf(one) as Uint8Array;
  bytes[8] = 1;
  expect(() => new Palette(bytes).decode(() => {})).toThrow("damaged");
});

test("damaged bytes are errors or finite Gaussians", () => {
  const next = seeded(1);
  const random = (below: number) => Math.floor(below * next());
  let refused = 0;
  let finite = true;
  for (let i = 0; i < 1000; i++) {
    const one = golden[i % golden.length] as Golden;
    const bytes = bytesOf(one);
    for (let k = random(3); k >= 0; k--) bytes[random(bytes.length)] = random(256);
    try {
      const all = decoded(bytes, paletteOf(one)).flatMap((g) => [
        g.means,
        g.quats,
        g.logScales,
        g.opacities,
        g.sh0,
        g.shN,
      ]);
      finite &&= all.every((values) => values.every(Number.isFinite));
    } catch (error) {
      if ((error as Error).constructor !== Error) throw error; // such as a RangeError of an array
      refused++;
    }
  }
  expect(finite).toBe(true);
  expect(refused).toBeGreaterThan(500);
});

test("no damage does more than a plain error, or takes more memory than the bytes may hold", () => {
  const found = fuzz(golden.map(fileOf), 24, { most: 1500 });
  expect(found.wrong).toEqual([]);
  expect(found.tried).toBe(1500);
  expect(Math.min(found.decoded, found.refused)).toBeGreaterThan(100);
});
