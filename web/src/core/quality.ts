/**
 * SSIM of a label at each level from any viewpoint. Same formulas as src/sagesplat/adapt/viewpoint.py;
 * tests/data/promises.json checks both.
 */

import type { Curve, Label, Promises, Vec3 } from "../types";

/** The prediction for one label at one viewpoint. */
export interface Prediction {
  readonly mean: readonly number[]; // by level, expected SSIM, never falls; NaN: unknown
  readonly bound: readonly number[]; // by level, lower confidence bound of SSIM, never falls
  readonly support: number; // 1 at a known viewpoint, 0 far from all of them; NaN: no model
}

/** Eq. 3 at a distance, clamped to the fitted range; the median for an unknown distance (NaN). */
export function curveAt(curve: Curve, distance: number): number {
  if (Number.isNaN(distance)) return clip(curve.median);
  const [K1, g1, mu1, a1, K2, g2, mu2, a2, beta] = curve.params;
  const d = Math.min(Math.max(distance, curve.range[0]), curve.range[1]);
  const near = d < beta;
  const [K, g, mu, a] = near ? [K1, g1, mu1, a1] : [K2, g2, mu2, a2];
  return clip(K * Math.exp(-g * Math.abs(d - mu) ** a));
}

/** The prediction from the distance alone, until the viewpoint model is loaded. */
export function byDistance(label: Label, distance: number): Prediction {
  const unknown = label.levels.map(() => Number.NaN);
  const quality = label.quality;
  if (!quality) return { mean: unknown, bound: unknown, support: Number.NaN };
  const values = quality.curves.map((curve) => curveAt(curve, distance));
  const low = values.map((value, i) => clip(value + (quality.margin[i] ?? 0)));
  const levels = quality.curves.map((curve) => curve.level);
  return {
    mean: spread(rising(values), levels, unknown),
    bound: spread(running(low, Math.max), levels, unknown),
    support: Number.NaN,
  };
}

/** Exponent of the kernel weights in `corrected`, and the weight at which a correction counts by half. */
const LIKE = 16;
const ENOUGH = 1e-3;

type LabelPromises = Promises["labels"][number];

/** The views that the models of all labels share, and their scaled distances from the current viewpoint. */
export class Views {
  readonly away: Float64Array; // [V] square of the distance over the extent
  readonly turned: Float64Array; // [V] square of the difference of the directions
  private readonly rows: Float64Array; // [V, 6]
  private readonly extent: number;
  private position: Vec3 | null = null;
  private direction: Vec3 | null = null;

  constructor({ views, extent }: Promises) {
    this.rows = Float64Array.from(
      views.flatMap(([x, y, z, ...d]) => [x / extent, y / extent, z / extent, ...d]),
    );
    this.extent = extent;
    this.away = new Float64Array(views.length);
    this.turned = new Float64Array(views.length);
  }

  /** Computes `away` and `turned` for a viewpoint, once for all labels. */
  from(position: Vec3, direction: Vec3): void {
    if (position === this.position && direction === this.direction) return;
    [this.position, this.direction] = [position, direction];
    const { rows, extent } = this;
    const [x, y, z] = [position[0] / extent, position[1] / extent, position[2] / extent];
    const [a, b, c] = direction;
    for (let i = 0, at = 0; i < this.away.length; i++, at += 6) {
      this.away[i] = square(x, y, z, rows, at);
      this.turned[i] = square(a, b, c, rows, at + 3);
    }
  }

  /** The same squares between two views. */
  between(i: number, j: number): [number, number] {
    const { rows } = this;
    const [a, b] = [6 * i, 6 * i + 3];
    return [
      square(rows[a] as number, rows[a + 1] as number, rows[a + 2] as number, rows, 6 * j),
      square(rows[b] as number, rows[b + 1] as number, rows[b + 2] as number, rows, 6 * j + 3),
    ];
  }
}

function square(x: number, y: number, z: number, rows: Float64Array, at: number): number {
  const dx = x - (rows[at] as number);
  const dy = y - (rows[at + 1] as number);
  const dz = z - (rows[at + 2] as number);
  return dx * dx + dy * dy + dz * dz;
}

/** A label's viewpoint model; its Cholesky factor is computed when the label is first in sight. */
export class ViewModel {
  private factor: Float64Array | null = null; // [n, n] lower
  private readonly weights: Float64Array; // [K, n]
  private readonly unseen: Float64Array; // [n] variance at held-out views
  private readonly scale: Vec3; // of squares: of positions, directions, log distances
  private readonly n: number;
  private readonly curves: readonly Curve[];
  private readonly meanShare: number;

  constructor(
    private readonly label: Label,
    private readonly views: Views,
    private readonly own: LabelPromises,
  ) {
    this.n = own.views.length;
    const curves = label.quality?.curves ?? [];
    this.curves = own.levels.flatMap((level) => curves.filter((curve) => curve.level === level));
    const [x, y, z] = own.lengths;
    this.scale = [x ** -2, y ** -2, z ** -2];
    this.weights = Float64Array.from(
      this.curves.flatMap((_, level) => own.weights.map((row) => row[level] ?? 0)),
    );
    this.unseen = Float64Array.from(own.unseenViews, (u) => own.unseen * u);
    this.meanShare = own.shares.reduce((sum, s) => sum + s, 0) / Math.max(own.shares.length, 1);
  }

  /** Whether the label has a curve for each level of its model. */
  static fits(label: Label, own: LabelPromises): boolean {
    const known = (label.quality?.curves ?? []).map((curve) => curve.level);
    return own.levels.every((level) => known.includes(level) && level <= label.levels.length);
  }

  /**
   * @param distance - to the label, the bundle's units, NaN: unknown
   * @param position - of the viewer, the bundle's units
   * @param direction - in which it looks, unit length
   */
  predict(distance: number, position: Vec3, direction: Vec3): Prediction {
    const { own, n, scale } = this;
    this.views.from(position, direction);
    const log = distance > 0 && distance < Infinity ? Math.log(distance) : own.usual;
    const k = new Float64Array(n);
    let support = 0;
    for (let i = 0; i < n; i++) {
      const further = log - (own.logDistances[i] as number);
      const alike = matern(this.square(own.views[i] as number) + further * further * scale[2]);
      support = Math.max(support, alike);
      k[i] = alike + (this.unseen[i] as number);
    }
    const mean = this.curves.map((curve, level) => {
      let moved = 0;
      for (let i = 0; i < n; i++) moved += (k[i] as number) * (this.weights[level * n + i] as number);
      return curveAt(curve, distance) + moved + own.shift;
    });
    this.factor ??= cholesky(this.covariance(), n);
    const variance = Math.max(1 + own.unseen + own.noise - explained(this.factor, k), 0);
    return this.promise(mean, Math.sqrt(variance), support);
  }

  /** A distance by boxes, corrected by their errors in the label's views nearby; NaN stays NaN. */
  corrected(distance: number, position: Vec3, direction: Vec3): number {
    const { views, corrections } = this.own;
    this.views.from(position, direction);
    let [sum, total] = [0, 0];
    for (let i = 0; i < views.length; i++) {
      const weight = matern(this.square(views[i] as number)) ** LIKE;
      sum += weight * (corrections[i] as number);
      total += weight;
    }
    return distance * Math.exp(sum / (total + ENOUGH));
  }

  /** The label's pixel share at a viewpoint, from the known views near it, 0..1. */
  share(position: Vec3, direction: Vec3): number {
    const { shares } = this.own;
    this.views.from(position, direction);
    let [sum, total] = [0, 0];
    for (let view = 0; view < shares.length; view++) {
      const alike = maternTable(this.square(view));
      sum += alike * (shares[view] as number);
      total += alike;
    }
    return total > 1e-12 ? sum / total : this.meanShare;
  }

  /** Square of the scaled difference between the current viewpoint and a view. */
  private square(view: number): number {
    return (
      (this.views.away[view] as number) * this.scale[0] + (this.views.turned[view] as number) * this.scale[1]
    );
  }

  private promise(mean: readonly number[], deviation: number, support: number): Prediction {
    const { own, label } = this;
    const kept = rising(mean);
    const low = kept.map((m, level) => {
      return m - Math.hypot(own.factor * deviation * (own.amplitudes[level] ?? 0), own.mixing);
    });
    const unknown = label.levels.map(() => Number.NaN);
    return {
      mean: spread(kept, own.levels, unknown),
      bound: spread(running(low, Math.max), own.levels, unknown),
      support,
    };
  }

  private covariance(): Float64Array {
    const { n, own, views, scale } = this;
    const S = new Float64Array(n * n);
    for (let i = 0; i < n; i++) {
      for (let j = 0; j <= i; j++) {
        const both = (this.unseen[i] as number) * (own.unseenViews[j] ?? 0);
        const [away, turned] = views.between(own.views[i] as number, own.views[j] as number);
        const further = (own.logDistances[i] as number) - (own.logDistances[j] as number);
        const alike = matern(away * scale[0] + turned * scale[1] + further * further * scale[2]);
        S[i * n + j] = alike + both + (i === j ? own.noise : 0);
      }
    }
    return S;
  }
}

/** Matern 3/2 of the square of a scaled difference. */
function matern(square: number): number {
  const scaled = Math.sqrt(3 * square);
  return (1 + scaled) * Math.exp(-scaled);
}

const STEPS = 256; // of a table of it, in a unit of the scaled difference
const TABLE = Float64Array.from({ length: 32 * STEPS }, (_, i) => matern((i / STEPS) ** 2 / 3));

/** The same by a table, accurate to 2e-6: pixel shares sum over all views for each label. */
function maternTable(square: number): number {
  const at = Math.sqrt(3 * square) * STEPS;
  const i = Math.floor(at);
  if (!(i < TABLE.length - 1)) return 0;
  const low = TABLE[i] as number;
  return low + (at - i) * ((TABLE[i + 1] as number) - low);
}

/** The lower Cholesky factor of a symmetric positive definite matrix given by its lower half, in place. */
function cholesky(S: Float64Array, n: number): Float64Array {
  for (let j = 0; j < n; j++) {
    for (let i = j; i < n; i++) {
      let sum = S[i * n + j] as number;
      for (let k = 0; k < j; k++) sum -= (S[i * n + k] as number) * (S[j * n + k] as number);
      // rounding can make the pivot vanish
      S[i * n + j] = i === j ? Math.sqrt(Math.max(sum, 1e-12)) : sum / (S[j * n + j] as number);
    }
  }
  return S;
}

/** k' S^-1 k from the lower factor of S. */
function explained(factor: Float64Array, k: Float64Array): number {
  const n = k.length;
  const z = new Float64Array(n);
  let square = 0;
  for (let i = 0; i < n; i++) {
    let sum = k[i] as number;
    for (let j = 0; j < i; j++) sum -= (factor[i * n + j] as number) * (z[j] as number);
    const value = sum / (factor[i * n + i] as number);
    z[i] = value;
    square += value * value;
  }
  return square;
}

/** Monotone values: the mean of the running maximum and the running minimum from the end, in [-1, 1]. */
function rising(values: readonly number[]): number[] {
  const up = running(values, Math.max);
  const down = running([...values].reverse(), Math.min).reverse();
  return up.map((most, i) => clip((most + (down[i] ?? most)) / 2));
}

function running(values: readonly number[], pick: (a: number, b: number) => number): number[] {
  let last: number | undefined;
  return values.map((value) => {
    last = last === undefined ? value : pick(last, value);
    return last;
  });
}

/** Values of given levels (1-based) as an array over all levels. */
function spread(values: readonly number[], levels: readonly number[], among: readonly number[]): number[] {
  const out = [...among];
  levels.forEach((level, i) => {
    out[level - 1] = values[i] ?? Number.NaN;
  });
  return out;
}

const clip = (ssim: number): number => Math.min(Math.max(ssim, -1), 1);
