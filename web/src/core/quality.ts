/**
 * SSIM of a label at each level from any viewpoint. The formulas are those of src/sagesplat/adapt/promise.py;
 * tests/data/promises.json holds both to them.
 */

import type { Curve, Label, Promises, Vec3 } from "../types";

/** What is known of one label at one viewpoint. */
export interface Prediction {
  readonly mean: readonly number[]; // by level, expected SSIM, never falls; NaN: unknown
  readonly bound: readonly number[]; // by level, SSIM that can be promised, never falls
  readonly support: number; // 1 at a known viewpoint, 0 far from all; NaN: no model
}

/** Eq. 3 at a distance: beyond the fitted range the value at its end, the median where it is unknown (NaN). */
export function curveAt(curve: Curve, distance: number): number {
  if (Number.isNaN(distance)) return clip(curve.median);
  const [K1, g1, mu1, a1, K2, g2, mu2, a2, beta] = curve.params;
  const d = Math.min(Math.max(distance, curve.range[0]), curve.range[1]);
  const near = d < beta;
  const [K, g, mu, a] = near ? [K1, g1, mu1, a1] : [K2, g2, mu2, a2];
  return clip(K * Math.exp(-g * Math.abs(d - mu) ** a));
}

/** What the distance alone says of a label, as long as its viewpoint model is not there. */
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

/** Power of the kernel that known views speak of a distance with, and the least weight that counts. */
const LIKE = 16;
const ENOUGH = 1e-3;

type LabelPromises = Promises["labels"][number];

/** A label's viewpoint model, ready to be evaluated; its Cholesky factor is made here, once. */
export class ViewModel {
  private readonly inputs: Float64Array; // [n, 7] over the length scales
  private readonly all: Float64Array; // [V, 7] of all views of the bundle, for their shares of pixels
  private readonly factor: Float64Array; // [n, n] lower
  private readonly weights: Float64Array; // [K, n]
  private readonly unseen: Float64Array; // [n] its variance at unseen views
  private readonly n: number;
  private readonly curves: readonly Curve[];
  private readonly meanShare: number;

  constructor(
    private readonly label: Label,
    private readonly promises: Promises,
    private readonly own: LabelPromises,
  ) {
    this.n = own.views.length;
    const curves = label.quality?.curves ?? [];
    this.curves = own.levels.flatMap((level) => curves.filter((curve) => curve.level === level));
    this.all = new Float64Array(7 * promises.views.length);
    promises.views.forEach((v, i) => {
      this.put(this.all, i, [v[0], v[1], v[2]], [v[3], v[4], v[5]], 0);
    });
    this.inputs = new Float64Array(7 * this.n);
    own.views.forEach((row, i) => {
      this.inputs.set(this.all.subarray(7 * row, 7 * row + 6), 7 * i);
      this.inputs[7 * i + 6] = (own.logDistances[i] ?? 0) / own.lengths[2];
    });
    this.weights = Float64Array.from(
      this.curves.flatMap((_, level) => own.weights.map((row) => row[level] ?? 0)),
    );
    this.unseen = Float64Array.from(own.unseenViews, (u) => own.unseen * u);
    this.factor = cholesky(this.covariance(), this.n);
    this.meanShare = own.shares.reduce((sum, s) => sum + s, 0) / Math.max(own.shares.length, 1);
  }

  /** Whether the label has a curve for each level that its model speaks of. */
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
    const { own, n } = this;
    const x = new Float64Array(7);
    this.put(x, 0, position, direction, distance > 0 && distance < Infinity ? Math.log(distance) : own.usual);
    const k = new Float64Array(n);
    let support = 0;
    for (let i = 0; i < n; i++) {
      const alike = matern(x, 0, this.inputs, i, 7);
      support = Math.max(support, alike);
      k[i] = alike + (this.unseen[i] as number);
    }
    const mean = this.curves.map((curve, level) => {
      let moved = 0;
      for (let i = 0; i < n; i++) moved += (k[i] as number) * (this.weights[level * n + i] as number);
      return curveAt(curve, distance) + moved + own.shift;
    });
    const variance = Math.max(1 + own.unseen + own.noise - explained(this.factor, k), 0);
    return this.promise(mean, Math.sqrt(variance), support);
  }

  /** A distance by the boxes, corrected by what they miss at the label's own views close by; NaN stays. */
  corrected(distance: number, position: Vec3, direction: Vec3): number {
    const x = new Float64Array(7);
    this.put(x, 0, position, direction, 0);
    let [sum, total] = [0, 0];
    this.own.corrections.forEach((correction, i) => {
      const weight = matern(x, 0, this.inputs, i, 6) ** LIKE;
      sum += weight * correction;
      total += weight;
    });
    return distance * Math.exp(sum / (total + ENOUGH));
  }

  /** Share of the pixels that the label has around a viewpoint, from the known views near it, 0..1. */
  share(position: Vec3, direction: Vec3): number {
    const x = new Float64Array(7);
    this.put(x, 0, position, direction, 0);
    let [sum, total] = [0, 0];
    this.own.shares.forEach((share, view) => {
      const alike = matern(x, 0, this.all, view, 6);
      sum += alike * share;
      total += alike;
    });
    return total > 1e-12 ? sum / total : this.meanShare;
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

  private put(rows: Float64Array, i: number, position: Vec3, direction: Vec3, logDistance: number): void {
    const { lengths } = this.own;
    for (let axis = 0; axis < 3; axis++) {
      rows[7 * i + axis] = (position[axis] as number) / this.promises.extent / lengths[0];
      rows[7 * i + 3 + axis] = (direction[axis] as number) / lengths[1];
    }
    rows[7 * i + 6] = logDistance / lengths[2];
  }

  private covariance(): Float64Array {
    const { n, own } = this;
    const S = new Float64Array(n * n);
    for (let i = 0; i < n; i++) {
      for (let j = 0; j <= i; j++) {
        const both = (this.unseen[i] as number) * (own.unseenViews[j] ?? 0);
        S[i * n + j] = matern(this.inputs, i, this.inputs, j, 7) + both + (i === j ? own.noise : 0);
      }
    }
    return S;
  }
}

/** Matern 3/2 between two rows of 7 scaled inputs, of which the first `size` count. */
function matern(a: Float64Array, i: number, b: Float64Array, j: number, size: number): number {
  let square = 0;
  for (let at = 0; at < size; at++) {
    const away = (a[7 * i + at] as number) - (b[7 * j + at] as number);
    square += away * away;
  }
  const scaled = Math.sqrt(3 * square);
  return (1 + scaled) * Math.exp(-scaled);
}

/** The lower Cholesky factor of a symmetric positive definite matrix given by its lower half, in place. */
function cholesky(S: Float64Array, n: number): Float64Array {
  for (let j = 0; j < n; j++) {
    for (let i = j; i < n; i++) {
      let sum = S[i * n + j] as number;
      for (let k = 0; k < j; k++) sum -= (S[i * n + k] as number) * (S[j * n + k] as number);
      // rounded inputs can take the least bit of what the noise adds
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

/** Halfway between the largest so far and the smallest to come, kept in [-1, 1]: never falls. */
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

/** Values of some levels (1-based) among all. */
function spread(values: readonly number[], levels: readonly number[], among: readonly number[]): number[] {
  const out = [...among];
  levels.forEach((level, i) => {
    out[level - 1] = values[i] ?? Number.NaN;
  });
  return out;
}

const clip = (ssim: number): number => Math.min(Math.max(ssim, -1), 1);
