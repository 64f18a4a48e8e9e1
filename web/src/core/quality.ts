/**
 * Quality of a label at each level from any viewpoint. Same formulas as src/sagesplat/viewer/promises.py and
 * adapt/viewpoint.py; tests/data/promises.json checks them.
 */

import type { Curve, Label, LabelPromises, Promises, Quality, Trust, Viewpoint } from "../types";
import { covariance, matern, maternTable, solved } from "./process";

/** The prediction for one label at one viewpoint. */
export interface Prediction {
  readonly mean: readonly number[]; // by level, expected quality, never falls; NaN: unknown
  readonly bound: readonly number[]; // by level, lower confidence bound, never falls; NaN: no promise
  readonly support: number; // 1 at a known viewpoint, 0 far from all of them; NaN: no model
  readonly trust: Trust;
}

/** Where and on what screen: all that models know of a viewpoint. */
type From = Pick<Viewpoint, "position" | "direction" | "focal">;

/** Steps of positions over the extent, directions, log screens, shares, targets, thresholds and slopes. */
const STEP = 1e-4;
const CORRECTION_STEP = 5e-3;

/** Eq. 3 at a distance, clamped to the fitted range; the median for an unknown distance (NaN). */
export function curveAt(curve: Curve, distance: number): number {
  if (Number.isNaN(distance)) return clip(curve.median);
  const [K1, g1, mu1, a1, K2, g2, mu2, a2, beta] = curve.params;
  const d = Math.min(Math.max(distance, curve.range[0]), curve.range[1]);
  const near = d < beta;
  const [K, g, mu, a] = near ? [K1, g1, mu1, a1] : [K2, g2, mu2, a2];
  return clip(K * Math.exp(-g * Math.abs(d - mu) ** a));
}

/** What is known whatever the viewpoint, until the viewpoint models are loaded. */
export function anywhere(label: Label, quality: Quality): Prediction {
  const unknown = label.levels.map(() => Number.NaN);
  const known = label.quality[quality];
  if (!known) return { mean: unknown, bound: unknown, support: Number.NaN, trust: "unknown" };
  return {
    mean: spread(rising(known.mean), known.levels, unknown),
    bound: known.bound ? spread(running(known.bound, Math.max), known.levels, unknown) : unknown,
    support: Number.NaN,
    trust: known.bound ? known.status : "unknown",
  };
}

/** Exponent of the kernel weights in `corrected`, and the weight at which a correction counts by half. */
const NEIGHBOUR_EXPONENT = 16;
const HALF_WEIGHT = 1e-3;

const COLUMNS = 7; // of the shared views: position over the extent, direction, log screen
const PHOTO_COLUMNS = 6; // of the photos: without the screen
const PHOTO_LENGTHS = [0.3, 0.5] as const; // of position and direction, for how far one is from the photos

/** The views that the models of all labels share, and how far they are from the current viewpoint. */
export class Views {
  readonly away: Float64Array; // [V] square of the distance over the extent
  readonly turned: Float64Array; // [V] square of the difference of the directions
  readonly rescaled: Float64Array; // [V] square of the difference of the log screens
  readonly rows: Float64Array; // [V, COLUMNS]
  private readonly photos: Float64Array; // [P, PHOTO_COLUMNS]
  fromPhotos = Number.NaN; // of the current viewpoint: 0 at a photo, 1 far from all; NaN: none are known
  private last: From | null = null;

  constructor(private readonly sent: Pick<Promises, "views" | "photos" | "extent" | "focal" | "screens">) {
    this.rows = byRow(sent.views);
    this.photos = byRow(sent.photos);
    const count = this.rows.length / COLUMNS;
    this.away = new Float64Array(count);
    this.turned = new Float64Array(count);
    this.rescaled = new Float64Array(count);
  }

  /** Computes the differences from a viewpoint, once for all labels. */
  from(viewpoint: From): void {
    if (viewpoint === this.last) return;
    this.last = viewpoint;
    const { rows, sent } = this;
    const [x, y, z] = viewpoint.position.map((p) => p / sent.extent) as [number, number, number];
    const [a, b, c] = viewpoint.direction;
    const [smallest, largest] = sent.screens;
    const screen = Math.log(Math.min(Math.max(screenOf(viewpoint, sent), smallest), largest));
    for (let i = 0, at = 0; i < this.away.length; i++, at += COLUMNS) {
      this.away[i] = square(x, y, z, rows, at);
      this.turned[i] = square(a, b, c, rows, at + 3);
      this.rescaled[i] = (screen - (rows[at + 6] as number)) ** 2;
    }
    const [position, direction] = PHOTO_LENGTHS;
    let least = Infinity;
    for (let at = 0; at < this.photos.length; at += PHOTO_COLUMNS) {
      const away = square(x, y, z, this.photos, at) / position ** 2;
      least = Math.min(least, away + square(a, b, c, this.photos, at + 3) / direction ** 2);
    }
    this.fromPhotos = least < Infinity ? 1 - matern(least) : Number.NaN;
  }
}

/** Rows from the columns of a document, which hold differences. */
function byRow(columns: readonly (readonly number[])[]): Float64Array {
  const rows = new Float64Array(columns.length * (columns[0]?.length ?? 0));
  columns.forEach((column, c) => {
    sums(column, STEP).forEach((value, row) => {
      rows[row * columns.length + c] = value;
    });
  });
  return rows;
}

/** A viewpoint's screen: the focal length of what is drawn over the photos'. */
export const screenOf = ({ focal }: Pick<Viewpoint, "focal">, photos: Pick<Promises, "focal">): number =>
  (focal ?? photos.focal) / photos.focal;

function square(x: number, y: number, z: number, rows: Float64Array, at: number): number {
  const dx = x - (rows[at] as number);
  const dy = y - (rows[at + 1] as number);
  const dz = z - (rows[at + 2] as number);
  return dx * dx + dy * dy + dz * dz;
}

/** A label's viewpoint model; its weights are solved for when the label is first in sight. */
export class ViewModel {
  private weights: Float64Array | null = null; // [K, n]
  private readonly own: Int32Array; // [n] rows of the shared views
  private readonly logDistances: Float64Array; // [n]
  private readonly corrections: Float64Array; // [n]
  private readonly shares: Float64Array; // [V]
  private readonly targets: Float64Array;
  private readonly thresholds: Float64Array;
  private readonly slopes: Float64Array;
  private readonly scale: readonly [number, number, number, number]; // of squares, by group of inputs
  private readonly meanShare: number;

  constructor(
    private readonly label: Label,
    private readonly views: Views,
    private readonly sent: LabelPromises,
  ) {
    this.own = Int32Array.from(sums(sent.views, 1));
    this.logDistances = sums(sent.logDistances.steps, sent.logDistances.unit);
    this.corrections = sums(sent.corrections, CORRECTION_STEP);
    this.shares = sums(sent.shares, STEP);
    this.targets = Float64Array.from(sent.targets, (target) => target * STEP);
    this.thresholds = Float64Array.from(sent.thresholds, (threshold) => threshold * STEP);
    this.slopes = Float64Array.from(sent.slopes, (slope) => slope * STEP);
    const [position, direction, screen, log] = sent.lengths;
    this.scale = [position ** -2, direction ** -2, screen ** -2, log ** -2];
    this.meanShare = this.shares.reduce((sum, s) => sum + s, 0) / Math.max(this.shares.length, 1);
  }

  /** Whether the label has the levels of its model. */
  static fits(label: Label, sent: LabelPromises): boolean {
    return sent.levels.every((level) => level <= label.levels.length);
  }

  /**
   * @param distance - to the label, the bundle's units, NaN: unknown
   * @param viewpoint - in the bundle's frame
   */
  predict(distance: number, viewpoint: From): Prediction {
    const { sent, scale, views } = this;
    views.from(viewpoint);
    this.weights ??= this.solve();
    const n = this.own.length;
    const log = distance > 0 && distance < Infinity ? Math.log(distance) : sent.medianLogDistance;
    const near = new Float64Array(n);
    let support = 0;
    for (let i = 0; i < n; i++) {
      const view = this.own[i] as number;
      const further = log - (this.logDistances[i] as number);
      const seen = (views.rescaled[view] as number) * scale[2] + further * further * scale[3];
      near[i] = matern(this.square(view) + seen);
      support = Math.max(support, near[i] as number);
    }
    const { weights } = this;
    const mean = sent.levels.map((_, level) => {
      let moved = 0;
      for (let i = 0, at = level * n; i < n; i++) moved += (near[i] as number) * (weights[at + i] as number);
      const curve = sent.curves[level];
      return (curve ? curveAt(curve, distance) : 0) + (sent.offsets[level] as number) + moved;
    });
    return this.promise(rising(mean), support);
  }

  /** A distance by boxes, corrected by their errors in the label's views nearby; NaN stays NaN. */
  corrected(distance: number, viewpoint: From): number {
    this.views.from(viewpoint);
    let [sum, total] = [0, 0];
    for (let i = 0; i < this.own.length; i++) {
      const weight = matern(this.square(this.own[i] as number)) ** NEIGHBOUR_EXPONENT;
      sum += weight * (this.corrections[i] as number);
      total += weight;
    }
    return distance * Math.exp(sum / (total + HALF_WEIGHT));
  }

  /** The label's pixel share at a viewpoint, from the known views near it, 0..1. */
  share(viewpoint: From): number {
    const { shares } = this;
    this.views.from(viewpoint);
    let [sum, total] = [0, 0];
    for (let view = 0; view < shares.length; view++) {
      const alike = maternTable(this.square(view));
      sum += alike * (shares[view] as number);
      total += alike;
    }
    return total > 1e-12 ? sum / total : this.meanShare;
  }

  /** Square of the scaled difference in place between the current viewpoint and a view. */
  private square(view: number): number {
    return (
      (this.views.away[view] as number) * this.scale[0] + (this.views.turned[view] as number) * this.scale[1]
    );
  }

  private promise(mean: readonly number[], support: number): Prediction {
    const { sent, label } = this;
    const unknown = label.levels.map(() => Number.NaN);
    const known = this.targets.length > 0;
    const outside = support < sent.leastSupport;
    const far = this.views.fromPhotos;
    const needed = this.needed(Number.isNaN(far) ? 1 - support : far);
    const bound = mean.map((m) => (outside || !known ? Number.NaN : this.bound(m, needed)));
    return {
      mean: spread(mean, sent.levels, unknown),
      bound: spread(bound, sent.levels, unknown),
      support,
      trust: outside ? "outside" : known ? sent.status : "unknown",
    };
  }

  /** The mean from which on a level keeps each target that far away: never less than for a lower one, at most 1. */
  private needed(away: number): Float64Array {
    let least = -Infinity;
    return this.thresholds.map((threshold, g) => {
      least = Math.max(least, threshold + (this.slopes[g] as number) * away);
      return Math.min(least, 1);
    });
  }

  /** The largest target that a mean keeps, between targets interpolated. */
  private bound(mean: number, needed: Float64Array): number {
    const { targets } = this;
    const last = targets.length - 1;
    const above = needed.findIndex((threshold) => threshold > mean);
    if (above < 0) return targets[last] as number;
    const [t1, m1] = [targets[above] as number, needed[above] as number];
    if (above === 0) return mean + (t1 - m1);
    const [t0, m0] = [targets[above - 1] as number, needed[above - 1] as number];
    return t0 + ((t1 - t0) / (m1 - m0)) * (mean - m0);
  }

  /** The weights by which the process has the values that were sent. */
  private solve(): Float64Array {
    const { own, scale, logDistances, sent } = this;
    const { rows } = this.views;
    const [a, b, c, d] = scale.map(Math.sqrt) as [number, number, number, number];
    const by = [a, a, a, b, b, b, c];
    const scaled = new Float64Array((COLUMNS + 1) * own.length);
    for (let i = 0, at = 0; i < own.length; i++) {
      const row = COLUMNS * (own[i] as number);
      for (const [j, factor] of by.entries()) scaled[at++] = (rows[row + j] as number) * factor;
      scaled[at++] = (logDistances[i] as number) * d;
    }
    return solved(covariance(scaled, own.length), valuesOf(sent), own.length);
  }
}

/** Values [K, n] from their differences along the views and to the level below. */
function valuesOf({ values }: LabelPromises): Float64Array {
  const n = values.steps[0]?.length ?? 0;
  const out = new Float64Array(n * values.steps.length);
  const level = new Float64Array(n); // whole numbers, so the sums are exact
  values.steps.forEach((steps, k) => {
    let along = 0;
    for (let i = 0; i < n; i++) {
      along += steps[i] as number;
      level[i] = (level[i] as number) + along;
      out[k * n + i] = (level[i] as number) * (values.units[k] as number);
    }
  });
  return out;
}

/** Running sums of whole numbers, times a unit. */
function sums(steps: readonly number[], unit: number): Float64Array {
  let sum = 0;
  return Float64Array.from(steps, (step) => {
    sum += step;
    return sum * unit;
  });
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
