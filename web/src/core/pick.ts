/** What a ray meets: Gaussians in Spark's packed words, blended from front to back as a pixel is. */

import type { Vec3 } from "../types";

/** The splats of a label in main memory: four words each, in the order of its levels. */
export interface Packed {
  readonly label: number;
  readonly words: Uint32Array;
  readonly count: number;
  readonly hidden?: Uint8Array; // splats that are not shown, by rank
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

const half = (bits: number): number => HALVES[bits & 0xffff] as number;

export function positionOf(words: Uint32Array, rank: number): [number, number, number] {
  const [xy, z] = [words[4 * rank + 1] as number, words[4 * rank + 2] as number];
  return [half(xy), half(xy >>> 16), half(z)];
}

const scalesOf = ({ lnScaleMin, lnScaleMax }: Encoding): Float64Array =>
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
function meet({ label, words, count, hidden }: Packed, scales: Float64Array, ray: Ray, hits: Hit[]): void {
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
    if (alpha >= LEAST) hits.push({ label, rank, depth, alpha: Math.min(alpha, 0.99) });
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

/** How far apart neighbours of a region may be, in medians of the splats' largest standard deviation. */
const REACH = 2.5;
const FAINT = 25; // in 1/255: fainter splats join no others

/**
 * The splats of a label that are connected to one of them and of the colour around it, as a mask by rank.
 *
 * @param tolerance - distance from its colour, in 1 for each of red, green and blue
 * @param among - splats that may be taken, by rank; not 0: yes
 */
export function grow(
  { words, count }: Packed,
  encoding: Encoding,
  seed: number,
  tolerance: number,
  among?: Uint8Array,
): Uint8Array {
  const reach = REACH * medianScale(words, count, encoding);
  const cellOf = (rank: number, to: readonly number[] = [0, 0, 0]): string =>
    positionOf(words, rank)
      .map((value, axis) => Math.floor(value / reach) + (to[axis] ?? 0))
      .join();
  const colour = colourAround(words, count, seed, reach, among);
  const steps = (tolerance * 255) / (encoding.rgbMax - encoding.rgbMin);
  const cells = new Map<string, number[]>();
  for (let rank = 0; rank < count; rank++) {
    if ((among && !among[rank]) || !isAlike(words[4 * rank] as number, colour, steps)) continue;
    const key = cellOf(rank);
    const known = cells.get(key);
    if (known) known.push(rank);
    else cells.set(key, [rank]);
  }
  const mask = new Uint8Array(count);
  mask[seed] = 1;
  const queue = [seed];
  for (let next = queue.pop(); next !== undefined; next = queue.pop()) {
    const here = positionOf(words, next);
    for (const to of AROUND) {
      const key = cellOf(next, to);
      const left: number[] = [];
      for (const rank of cells.get(key) ?? []) {
        if (mask[rank]) continue;
        const there = positionOf(words, rank);
        if (Math.hypot(there[0] - here[0], there[1] - here[1], there[2] - here[2]) > reach) left.push(rank);
        else {
          mask[rank] = 1;
          queue.push(rank);
        }
      }
      if (cells.has(key)) cells.set(key, left);
    }
  }
  return mask;
}

const AROUND = Array.from({ length: 27 }, (_, i) => [
  (i % 3) - 1,
  (Math.floor(i / 3) % 3) - 1,
  Math.floor(i / 9) - 1,
]);

/** The mean colour of what is as near to a splat as its neighbours, in bytes, weighted by opacity. */
function colourAround(
  words: Uint32Array,
  count: number,
  seed: number,
  reach: number,
  among?: Uint8Array,
): readonly number[] {
  const here = positionOf(words, seed);
  const sums = [0, 0, 0];
  let total = 0;
  for (let rank = 0; rank < count; rank++) {
    const there = positionOf(words, rank);
    const isNear = Math.hypot(there[0] - here[0], there[1] - here[1], there[2] - here[2]) <= reach;
    if (!isNear || (among && !among[rank])) continue;
    const word = words[4 * rank] as number;
    const opacity = (word >>> 24) + 1;
    total += opacity;
    for (const axis of [0, 1, 2]) sums[axis] = (sums[axis] ?? 0) + opacity * ((word >>> (8 * axis)) & 255);
  }
  return sums.map((sum) => sum / Math.max(total, 1));
}

function isAlike(word: number, colour: readonly number[], steps: number): boolean {
  if (word >>> 24 < FAINT) return false;
  let sum = 0;
  for (const axis of [0, 1, 2]) sum += (((word >>> (8 * axis)) & 255) - (colour[axis] ?? 0)) ** 2;
  return sum <= steps * steps;
}

function medianScale(words: Uint32Array, count: number, encoding: Encoding): number {
  const scales = scalesOf(encoding);
  const largest = new Float64Array(count);
  for (let rank = 0; rank < count; rank++) {
    const sizes = words[4 * rank + 3] as number;
    largest[rank] = scales[Math.max(sizes & 255, (sizes >>> 8) & 255, (sizes >>> 16) & 255)] as number;
  }
  return largest.sort()[count >> 1] || 1e-6;
}
