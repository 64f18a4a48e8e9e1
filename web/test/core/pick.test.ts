import { describe, expect, it } from "vitest";
import { grow } from "../../src/core/grow";
import { type Packed, pick, positionOf, type Ray } from "../../src/core/pick";
import type { Vec3 } from "../../src/types";
import { ENCODING as STREAMS } from "../../src/view/packing";

const ENCODING = { ...STREAMS, rgbMin: -0.45, rgbMax: 1.45 };

interface Splat {
  readonly at: Vec3;
  readonly rgb?: Vec3; // bytes
  readonly alpha?: number; // byte
  readonly scale?: number;
}

const half = (value: number): number => {
  if (value === 0) return 0;
  const exponent = Math.floor(Math.log2(Math.abs(value)));
  const fraction = Math.round((Math.abs(value) / 2 ** exponent - 1) * 1024);
  return (value < 0 ? 0x8000 : 0) | (((exponent + 15) << 10) + fraction);
};

const scaleByte = (scale: number): number =>
  Math.round(((Math.log(scale) - ENCODING.lnScaleMin) * 254) / (ENCODING.lnScaleMax - ENCODING.lnScaleMin)) +
  1;

/** Round splats without rotation, as Spark packs them. */
function cloud(label: number, splats: readonly Splat[]): Packed {
  const words = new Uint32Array(4 * splats.length);
  splats.forEach(({ at, rgb = [100, 100, 100], alpha = 255, scale = 0.1 }, i) => {
    const [x, y, z] = at.map(half) as [number, number, number];
    const byte = scaleByte(scale);
    words[4 * i] = (rgb[0] | (rgb[1] << 8) | (rgb[2] << 16) | (alpha << 24)) >>> 0;
    words[4 * i + 1] = (x | (y << 16)) >>> 0;
    words[4 * i + 2] = (z | (255 << 16) | (128 << 24)) >>> 0;
    words[4 * i + 3] = byte | (byte << 8) | (byte << 16);
  });
  return { label, words, count: splats.length };
}

const AHEAD: Ray = { origin: [0, 0, 0], direction: [0, 0, -1], forward: [0, 0, -1], pixel: 0.002 };

describe("pick", () => {
  it("decodes positions", () => {
    const { words } = cloud(1, [{ at: [1.5, -0.25, -1024] }]);
    expect(positionOf(words, 0)).toEqual([1.5, -0.25, -1024]);
  });

  it("takes what is in front", () => {
    const far = cloud(1, [{ at: [0, 0, -5] }]);
    const near = cloud(2, [{ at: [9, 0, -3] }, { at: [0, 0, -3] }]);
    expect(pick([far, near], ENCODING, AHEAD)).toMatchObject({ label: 2, rank: 1 });
  });

  it("looks through what is faint, or hidden, and at what is behind nothing", () => {
    const far = cloud(1, [{ at: [0, 0, -5] }]);
    const veil = cloud(2, [{ at: [0, 0, -3], alpha: 40 }]);
    expect(pick([far, veil], ENCODING, AHEAD)?.label).toBe(1);
    const near = { ...cloud(2, [{ at: [0, 0, -3] }]), hidden: Uint8Array.of(1) };
    expect(pick([far, near], ENCODING, AHEAD)?.label).toBe(1);
  });

  it("meets nothing beside, behind the camera, or of faint splats alone", () => {
    const beside = cloud(1, [{ at: [1, 0, -5] }, { at: [0, 0, 5] }, { at: [0, 0, -4], alpha: 60 }]);
    expect(pick([beside], ENCODING, AHEAD)).toBeNull();
  });

  it("takes the label that paints most, though another is in front", () => {
    const front = cloud(1, [{ at: [0, 0, -2], alpha: 100 }]);
    const behind = cloud(2, [
      { at: [0, 0, -3], alpha: 120 },
      { at: [0, 0, -4], alpha: 200 },
    ]);
    expect(pick([front, behind], ENCODING, AHEAD)).toMatchObject({ label: 2 });
  });
});

describe("grow", () => {
  const row = (from: number, count: number, rgb?: Vec3): Splat[] =>
    Array.from({ length: count }, (_, i) => ({ at: [0.2 * (from + i), 0, -3], ...(rgb && { rgb }) }));

  it("takes neighbours of like colour that are connected", () => {
    const all = cloud(1, [...row(0, 10), ...row(20, 5), ...row(10, 4, [200, 40, 40])]);
    const mask = grow(all, ENCODING, 3, 0.2);
    expect([...mask]).toEqual([...Array(10).fill(1), ...Array(9).fill(0)]);
  });

  it("takes more with more tolerance, and only what may be taken", () => {
    const all = cloud(1, [...row(0, 5), ...row(5, 5, [140, 100, 100])]);
    expect(grow(all, ENCODING, 0, 0.05).reduce((a, b) => a + b)).toBe(5);
    expect(grow(all, ENCODING, 0, 0.3).reduce((a, b) => a + b)).toBe(10);
    const among = Uint8Array.of(1, 1, 1, 0, 1, 1, 1, 1, 1, 1);
    expect([...grow(all, ENCODING, 0, 0.3, among)].slice(0, 4)).toEqual([1, 1, 1, 0]);
  });

  it("takes a surface of light and dark splats, faint ones too, and not what is behind a gap", () => {
    const plank = row(0, 30).map((one, i) => ({ ...one, rgb: [100 + 40 * (i % 2), 90, 80] as const }));
    const veiled = plank.map((one, i) => (i === 7 ? { ...one, alpha: 10 } : one));
    const mask = grow(cloud(1, [...veiled, ...row(40, 5, [100, 90, 80])]), ENCODING, 3, 0.14);
    expect([...mask]).toEqual([...Array(30).fill(1), ...Array(5).fill(0)]);
  });

  it("reaches far along large splats", () => {
    const large: Splat = { at: [3, 0, -3], scale: 0.6 };
    const mask = grow(cloud(1, [...row(0, 9), large, ...row(20, 9)]), ENCODING, 0, 0.2);
    expect(mask.reduce((a, b) => a + b)).toBe(19);
  });
});
