/** Splats with two opacities, by the level that is shown. */

import { describe, expect, test } from "vitest";
import { StreamDecoder } from "../../src/core/stream";
import { blendOpacities, enterEarlier } from "../../src/view/opacity";
import { Packing } from "../../src/view/packing";
import { bytesOf, golden, paletteOf } from "../golden";

const cases = golden.filter(({ weights }) => weights);
const alphas = (words: Uint32Array) => [...words].flatMap((word, i) => (i % 4 ? [] : word >>> 24));

test("there are golden streams with two", () => expect(cases.length).toBeGreaterThan(1));

describe.each(cases)("$name", (one) => {
  const parts = new StreamDecoder(new Packing(), paletteOf(one)).push(bytesOf(one));

  /** What is drawn where a level is the newest one, of words with others besides. */
  function shown(level: number): number[] {
    const all = parts.slice(0, level);
    enterEarlier(all);
    return all.flatMap((part) => {
      const words = part.splats.slice();
      blendOpacities(words, part, (one.weights?.[level - 1] ?? 0) / 255);
      return alphas(words);
    });
  }

  test("every level has the opacities that Python says", () => {
    one.levels?.forEach((expected, i) => {
      const found = shown(i + 1);
      expect(found.length).toBe(expected.length);
      const off = found.filter((alpha, k) => Math.abs(alpha - 255 * (expected[k] as number)) > 0.5 + 1e-3);
      expect(off).toEqual([]);
    });
  });

  test("nothing but opacities changes", () => {
    for (const part of parts) {
      const words = part.splats.slice();
      const before = words.map((word, i) => (i % 4 ? word : word & 0xffffff));
      blendOpacities(words, part, 0.4);
      expect(words.map((word, i) => (i % 4 ? word : word & 0xffffff))).toEqual(before);
    }
  });
});

test("a logit is linear in the weight", () => {
  const logit = (byte: number) => Math.log(byte / (255 - byte));
  const opacities = Uint8Array.from({ length: 254 * 2 }, (_, i) => 1 + ((i * 89) % 254));
  const part = {
    count: 254,
    splats: new Uint32Array(4 * 254),
    harmonics: new Map(),
    opacities,
  };
  for (const weight of [0, 0.25, 0.6, 1]) {
    const words = new Uint32Array(4 * 254);
    blendOpacities(words, part, weight);
    alphas(words).forEach((alpha, i) => {
      const [a, b] = [logit(opacities[2 * i] as number), logit(opacities[2 * i + 1] as number)];
      expect(Math.abs(alpha - 255 / (1 + Math.exp(-(a * (1 - weight) + b * weight))))).toBeLessThan(0.5001);
    });
  }
});

test("parts with one opacity stay as they are", () => {
  const part = {
    count: 2,
    splats: new Uint32Array(8),
    harmonics: new Map(),
    opacities: null,
  };
  const words = new Uint32Array(8).fill(0x7f123456);
  blendOpacities(words, part, 1);
  expect([...words]).toEqual(Array(8).fill(0x7f123456));
});
