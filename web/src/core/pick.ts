/** What a ray meets: Gaussians in Spark's packed words, blended from front to back as a pixel is. */

import type { Vec3 } from "../types";

/** The splats of a label, or of one of its cells, in main memory: four words each, in the order of levels. */
export interface Packed {
  readonly label: number;
  readonly first?: number; // rank in the label of the first one
  readonly words: Uint32Array;
  readonly count: number;
  readonly level?: number; // that the first one came with
  readonly hidden?: Uint8Array; // splats that are not shown
}

export interface Encoding {
  readonly rgbMin: number;
  readonly rgbMax: number;
  readonly lnScaleMin: number;
  readonly lnScaleMax: number;
}

/** A ray in the bundle's frame. */
export interface Ray {
  readonly origin: Vec3;
  readonly direction: Vec3; // unit
  readonly forward: Vec3; // unit: of the camera, which depth is measured along
  readonly pixel: number; // radians: width of a pixel
}

export interface Picked {
  readonly label: number; // that paints most of the pixel
  readonly rank: number; // of the splat of this label that paints most
  readonly alpha: number; // of all that the ray meets
}

const FARTHEST = 3.33; // standard deviations, as the renderer draws them
const LEAST = 1 / 255; // alpha
const BLUR = 0.3; // px^2, of every splat
const ENOUGH = 1e-3; // of the light left, where blending ends
const SEEN = 0.5; // alpha from which on something is met

/** Numbers of 16 bits as floats. */
const HALVES = (() => {
  const table = new Float32Array(1 << 16);
  for (let bits = 0; bits < table.length; bits++) {
    const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
    table[bits] = sign * (exponent ? 2 ** (exponent - 25) * (1024 + fraction) : 2 ** -24 * fraction);
  }
  return table;
})();

export const half = (bits: number): number => HALVES[bits & 0xffff] as number;

export function positionOf(words: Uint32Array, rank: number): [number, number, number] {
  const [xy, z] = [words[4 * rank + 1] as number, words[4 * rank + 2] as number];
  return [half(xy), half(xy >>> 16), half(z)];
}

export const scalesOf = ({ lnScaleMin, lnScaleMax }: Encoding): Float64Array =>
  Float64Array.from({ length: 256 }, (_, byte) =>
    byte ? Math.exp(lnScaleMin + ((byte - 1) * (lnScaleMax - lnScaleMin)) / 254) : 0,
  );

/** Rows of the rotation matrix of a splat. */
function rotationOf(words: Uint32Array, rank: number): number[] {
  const [shape, sizes] = [words[4 * rank + 2] as number, words[4 * rank + 3] as number];
  let x = (((shape >>> 16) & 255) / 255) * 2 - 1;
  let y = ((shape >>> 24) / 255) * 2 - 1;
  const z = 1 - Math.abs(x) - Math.abs(y);
  const fold = Math.max(-z, 0);
  x += x >= 0 ? -fold : fold;
  y += y >= 0 ? -fold : fold;
  const angle = ((sizes >>> 24) / 255) * Math.PI;
  const factor = Math.sin(angle / 2) / (Math.hypot(x, y, z) || 1);
  const [i, j, k, w] = [x * factor, y * factor, z * factor, Math.cos(angle / 2)];
  return [
    1 - 2 * (j * j + k * k),
    2 * (i * j - k * w),
    2 * (i * k + j * w),
    2 * (i * j + k * w),
    1 - 2 * (i * i + k * k),
    2 * (j * k - i * w),
    2 * (i * k - j * w),
    2 * (j * k + i * w),
    1 - 2 * (i * i + j * j),
  ];
}

/** The axes of a splat, each as long as its standard deviation, the longest first. */
export function axesOf(
  words: Uint32Array,
  rank: number,
  scales: Float64Array,
): [number[], number[], number[]] {
  const [rotation, sizes] = [rotationOf(words, rank), words[4 * rank + 3] as number];
  const axes = [0, 1, 2].map((axis) => {
    const scale = scales[(sizes >>> (8 * axis)) & 255] as number;
    return { scale, along: [0, 3, 6].map((row) => scale * (rotation[row + axis] as number)) };
  });
  const [a, b, c] = axes.sort((one, other) => other.scale - one.scale).map(({ along }) => along);
  return [a, b, c] as [number[], number[], number[]];
}

interface Hit {
  readonly label: number;
  readonly rank: number;
  readonly depth: number;
  readonly alpha: number;
}

/** The label that paints most of the pixel of a ray, and its splat that does; null where nothing is met. */
export function pick(clouds: readonly Packed[], encoding: Encoding, ray: Ray): Picked | null {
  const scales = scalesOf(encoding);
  const hits: Hit[] = [];
  for (const cloud of clouds) meet(cloud, scales, ray, hits);
  hits.sort((a, b) => a.depth - b.depth);
  const shares = new Map<number, { sum: number; most: number; rank: number }>();
  let light = 1;
  for (const { label, rank, alpha } of hits) {
    const weight = light * alpha;
    const known = shares.get(label) ?? { sum: 0, most: 0, rank };
    const best = weight > known.most;
    shares.set(label, {
      sum: known.sum + weight,
      most: best ? weight : known.most,
      rank: best ? rank : known.rank,
    });
    light -= weight;
    if (light < ENOUGH) break;
  }
  if (1 - light < SEEN) return null;
  const [label, { rank }] = [...shares].reduce((a, b) => (b[1].sum > a[1].sum ? b : a));
  return { label, rank, alpha: 1 - light };
}

/** Adds the splats of a label that a ray meets. */
function meet(
  { label, first = 0, words, count, hidden }: Packed,
  scales: Float64Array,
  ray: Ray,
  hits: Hit[],
): void {
  const [ox, oy, oz] = ray.origin;
  const [dx, dy, dz] = ray.direction;
  const [fx, fy, fz] = ray.forward;
  const blur = Math.sqrt(BLUR) * ray.pixel;
  for (let rank = 0, at = 0; rank < count; rank++, at += 4) {
    const xy = words[at + 1] as number;
    const x = half(xy) - ox;
    const y = half(xy >>> 16) - oy;
    const z = half(words[at + 2] as number) - oz;
    const depth = x * fx + y * fy + z * fz;
    if (depth <= 0) continue;
    const along = x * dx + y * dy + z * dz;
    const sizes = words[at + 3] as number;
    const widest = scales[Math.max(sizes & 255, (sizes >>> 8) & 255, (sizes >>> 16) & 255)] as number;
    const reach = FARTHEST * (widest + blur * depth);
    if (x * x + y * y + z * z - along * along > reach * reach || hidden?.[rank]) continue;
    const opacity = ((words[at] as number) >>> 24) / 255;
    const alpha = opacity * response(words, rank, scales, [x, y, z], ray.direction, blur * depth);
    if (alpha >= LEAST) hits.push({ label, rank: first + rank, depth, alpha: Math.min(alpha, 0.99) });
  }
}

/** The largest value of a splat's Gaussian along a ray; `to`: from the ray's origin to its centre. */
function response(
  words: Uint32Array,
  rank: number,
  scales: Float64Array,
  to: Vec3,
  direction: Vec3,
  blur: number,
): number {
  const rotation = rotationOf(words, rank);
  const sizes = words[4 * rank + 3] as number;
  let [pp, pq, qq] = [0, 0, 0];
  for (let axis = 0; axis < 3; axis++) {
    const [a, b, c] = [rotation[axis], rotation[3 + axis], rotation[6 + axis]] as [number, number, number];
    const scale = Math.hypot(scales[(sizes >>> (8 * axis)) & 255] as number, blur);
    const p = (a * to[0] + b * to[1] + c * to[2]) / scale;
    const q = (a * direction[0] + b * direction[1] + c * direction[2]) / scale;
    pp += p * p;
    pq += p * q;
    qq += q * q;
  }
  return Math.exp(-0.5 * Math.max(pp - (pq * pq) / qq, 0));
}
