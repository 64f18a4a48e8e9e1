/**
 * Quality of cells at each level, and what a label keeps, from any viewpoint. Same formulas as
 * src/sagesplat/viewer/promises.py and adapt/viewpoint.py; tests/data/promises.json checks them.
 */

import type {
  CellPromises,
  Curve,
  Label,
  LabelPromises,
  LabelQuality,
  Promises,
  Trust,
  Viewpoint,
} from "../types";
import { covariance, matern, solved } from "./process";

/** What a label keeps at a viewpoint. */
export interface Outlook {
  readonly keeps: Keeps | null; // null: no promise
  readonly support: number; // 1 at a known viewpoint, 0 far from all of them; NaN: no model
  readonly trust: Trust;
}

/** Ascending targets, and the mean quality from which on each is kept, which never falls. */
export interface Keeps {
  readonly targets: ArrayLike<number>;
  readonly needed: ArrayLike<number>;
}

/** Where, on what screen and through what lens: all that models know of a viewpoint. */
type From = Pick<Viewpoint, "position" | "direction" | "focal" | "lens">;

/** Steps of positions over the extent, directions, log screens and fields, targets, thresholds and slopes. */
const STEP = 1e-4;
const STEPS_PER_UNIT = 10_000;
const CORRECTION_STEP = 5e-3;
const FACTOR_STEP = 0.05;
const VALUE_STEP = 0.03;
const LEAST_MISSING = 0.025; // that a level's deviation is a part of
const ROUNDED = 1e-9; // by which sums of the same means differ

/** Eq. 3 at a distance, clamped to the fitted range; the median for an unknown distance (NaN). */
export function curveAt(curve: Curve, distance: number): number {
  if (Number.isNaN(distance)) return clip(curve.median);
  const [K1, g1, mu1, a1, K2, g2, mu2, a2, beta] = curve.params;
  const d = Math.min(Math.max(distance, curve.range[0]), curve.range[1]);
  const near = d < beta;
  const [K, g, mu, a] = near ? [K1, g1, mu1, a1] : [K2, g2, mu2, a2];
  return clip(K * Math.exp(-g * Math.abs(d - mu) ** a));
}

/** The mean quality that a target needs: linear between targets; Infinity beyond the last one. */
export function neededFor({ targets, needed }: Keeps, target: number): number {
  const last = targets.length - 1;
  if (!(last >= 0) || target > at(targets, last)) return Infinity;
  let above = 0;
  while (at(targets, above) < target) above += 1;
  const [t1, m1] = [at(targets, above), at(needed, above)];
  if (above === 0) return m1 - (t1 - target);
  const [t0, m0] = [at(targets, above - 1), at(needed, above - 1)];
  return m0 + ((m1 - m0) / (t1 - t0)) * (target - t0);
}

/** The largest target that a mean keeps, between targets interpolated. */
export function boundOf({ targets, needed }: Keeps, mean: number): number {
  const last = targets.length - 1;
  if (Number.isNaN(mean) || last < 0) return Number.NaN;
  let above = 0;
  while (above <= last && at(needed, above) <= mean) above += 1;
  if (above > last) return at(targets, last);
  const [t1, m1] = [at(targets, above), at(needed, above)];
  if (above === 0) return mean + (t1 - m1);
  const [t0, m0] = [at(targets, above - 1), at(needed, above - 1)];
  return t0 + ((t1 - t0) / (m1 - m0)) * (mean - m0);
}

/** All targets are kept by what is expected of the last levels, however far from photos. */
export function keptByLast(outlook: Outlook, last: number): Outlook {
  const { keeps } = outlook;
  if (!keeps || Number.isNaN(last)) return outlook;
  const needed = Float64Array.from(keeps.needed, (mean) => Math.min(mean, last - ROUNDED));
  return { ...outlook, keeps: { targets: keeps.targets, needed } };
}

/** What is known whatever the viewpoint, until the viewpoint models are loaded: means of so many levels. */
export function meansAnywhere(known: LabelQuality | undefined, levels: number): number[] {
  return known ? spread(rising(known.mean), known.levels, levels) : spread([], [], levels);
}

export function outlookAnywhere(known: LabelQuality | undefined): Outlook {
  if (!known?.bound) return { keeps: null, support: Number.NaN, trust: "unknown" };
  const keeps = { targets: running(known.bound, Math.max), needed: rising(known.mean) };
  return { keeps, support: Number.NaN, trust: known.status };
}

/** Exponent of the kernel weights in `corrected`, and the weight at which a correction counts by half. */
const NEIGHBOUR_EXPONENT = 16;
const HALF_WEIGHT = 1e-3;

const COLUMNS = 8; // of the shared views: position over the extent, direction, log screen, log field
const PHOTO_COLUMNS = 6; // of the photos: position and direction
const [STRICTER_SCREEN, STRICTER_FIELD, STRICTER_BOTH] = [0.05, 0.15, -0.2] as const; // of logs of screen and field
const PLACE_LENGTHS = [0.3, 0.5] as const; // of position and direction, for photos and factors

function logStrictness(screen: number, field: number): number {
  return STRICTER_SCREEN * screen + STRICTER_FIELD * field + STRICTER_BOTH * screen * field;
}

/** The views that the models of all labels share, and how far they are from the current viewpoint. */
export class Views {
  readonly away: Float64Array; // [V] square of the distance over the extent
  readonly turned: Float64Array; // [V] square of the difference of the directions
  readonly rescaled: Float64Array; // [V] square of the difference of the log screens and log fields
  readonly alike: Float64Array; // [V] of place: 1 at the view
  readonly rows: Float64Array; // [V, COLUMNS]
  private readonly photos: Float64Array; // [P, PHOTO_COLUMNS]
  strictness = 1; // of screen and lens: divides the loss that thresholds allow; 1 of one label alone
  private readonly usual: number; // log of the strictness, mean over the views
  fromPhotos = Number.NaN; // of the current viewpoint: 0 at a photo, 1 far from all; NaN: none are known

  constructor(
    private readonly sent: Pick<
      Promises,
      "quality" | "views" | "photos" | "extent" | "focal" | "screens" | "levels" | "labels"
    >,
  ) {
    this.rows = byRow(sent.views);
    this.photos = byRow(sent.photos);
    const count = this.rows.length / COLUMNS;
    this.away = new Float64Array(count);
    this.turned = new Float64Array(count);
    this.rescaled = new Float64Array(count);
    this.alike = new Float64Array(count);
    let sum = 0;
    for (let at = 0; at < this.rows.length; at += COLUMNS) {
      sum += logStrictness(this.rows[at + 6] as number, this.rows[at + 7] as number);
    }
    this.usual = sum / Math.max(count, 1);
  }

  /** Levels of the ladder that cells' levels are of. */
  get levels(): number {
    return this.sent.levels ?? 0;
  }

  /** Computes the differences from a viewpoint, once for all labels. */
  from(viewpoint: From): void {
    const { rows, sent } = this;
    const [x, y, z] = viewpoint.position.map((p) => p / sent.extent) as [number, number, number];
    const [a, b, c] = viewpoint.direction;
    const [smallest, largest] = sent.screens;
    const screen = Math.log(Math.min(Math.max(screenOf(viewpoint, sent), smallest), largest));
    // SSIM is known in the photos' pictures alone
    const field = sent.quality === "ssim" ? 0 : Math.log(fieldOf(viewpoint));
    if (sent.labels.length > 1) this.strictness = Math.exp(logStrictness(screen, field) - this.usual);
    const [position, direction] = PLACE_LENGTHS;
    for (let i = 0, at = 0; i < this.away.length; i++, at += COLUMNS) {
      const away = square(x, y, z, rows, at);
      const turned = square(a, b, c, rows, at + 3);
      this.away[i] = away;
      this.turned[i] = turned;
      this.rescaled[i] = (screen - (rows[at + 6] as number)) ** 2 + (field - (rows[at + 7] as number)) ** 2;
      this.alike[i] = matern(away / position ** 2 + turned / direction ** 2);
    }
    let least = Infinity;
    for (let at = 0; at < this.photos.length; at += PHOTO_COLUMNS) {
      const away = square(x, y, z, this.photos, at) / position ** 2;
      least = Math.min(least, away + square(a, b, c, this.photos, at + 3) / direction ** 2);
    }
    this.fromPhotos = least < Infinity ? 1 - matern(least) : Number.NaN;
  }
}

/** Rows from the columns of a document. */
function byRow(columns: readonly (readonly number[])[]): Float64Array {
  const rows = new Float64Array(columns.length * (columns[0]?.length ?? 0));
  columns.forEach((column, c) => {
    column.forEach((steps, row) => {
      rows[row * columns.length + c] = steps * STEP;
    });
  });
  return rows;
}

/** A viewpoint's screen: the focal length of what is drawn over the photos'. */
export const screenOf = ({ focal }: Pick<Viewpoint, "focal">, photos: Pick<Promises, "focal">): number =>
  (focal ?? photos.focal) / photos.focal;

/** A viewpoint's field: root of the picture's area, at distance 1. */
const fieldOf = ({ lens: [x, y] }: Pick<Viewpoint, "lens">): number => 2 * Math.sqrt(x * y);

function square(x: number, y: number, z: number, rows: Float64Array, at: number): number {
  const dx = x - (rows[at] as number);
  const dy = y - (rows[at + 1] as number);
  const dz = z - (rows[at + 2] as number);
  return dx * dx + dy * dy + dz * dz;
}

/** Factors of squares that divide inputs by their length scales: position, direction, screen and field, distance. */
const scalesOf = ({ lengths }: LabelPromises) =>
  lengths.map((length) => length ** -2) as [number, number, number, number];

/** The viewpoint model of a cell, or of a label as a whole; its weights are solved for when it is first in sight. */
export class CellModel {
  private weights: Float64Array | null = null; // [J, n], of a cell's terms, or [K, n]
  private readonly shapes: readonly Float64Array[]; // [J] of [K], by how much each term moves the levels
  private readonly known: readonly number[]; // [K] levels with a prediction
  private readonly offsets: readonly number[]; // [K]
  private readonly own: readonly number[]; // [n] rows of the shared views
  private readonly logDistances: Float64Array; // [n]
  private readonly corrections: Float64Array; // [n]
  private readonly factors: Float64Array; // [V]
  private readonly usual: number; // mean factor

  constructor(
    private readonly levels: number, // of the cell
    private readonly views: Views,
    private readonly sent: CellPromises,
    private readonly scale: readonly [number, number, number, number],
  ) {
    this.offsets = sent.offsets.map((steps) => steps / STEPS_PER_UNIT);
    this.shapes = shapesOf(sent, this.offsets, views.levels);
    this.known = sent.levels ?? sent.offsets.map((_, k) => k + 1);
    this.own = sent.rows;
    this.logDistances = Float64Array.from(sent.logDistances, (steps) => steps * sent.logUnit);
    this.corrections = Float64Array.from(sent.corrections ?? [], (steps) => steps * CORRECTION_STEP);
    this.factors = Float64Array.from(sent.factors ?? [], (steps) => (steps < 0 ? -1 : steps * FACTOR_STEP));
    const known = this.factors.filter((factor) => factor >= 0);
    this.usual = known.length ? known.reduce((sum, factor) => sum + factor, 0) / known.length : 1;
  }

  /**
   * Expected quality by level, which never falls; NaN: unknown.
   *
   * @param distance - the bundle's units, NaN: unknown
   */
  mean(distance: number): number[] {
    this.weights ??= this.solve();
    const { sent, weights } = this;
    const near = this.near(distance).map(matern);
    const n = near.length;
    const moved = (row: number) => {
      let sum = 0;
      for (let i = 0, at = row * n; i < n; i++) sum += (near[i] as number) * (weights[at + i] as number);
      return sum;
    };
    const mean = this.offsets.map((offset, k) => {
      if (sent.terms) return offset;
      const curve = sent.curves?.[k];
      return (curve ? curveAt(curve, distance) : 0) + offset + moved(k);
    });
    this.shapes.forEach((shape, j) => {
      const term = moved(j);
      shape.forEach((by, k) => {
        mean[k] = (mean[k] as number) + term * by;
      });
    });
    return spread(rising(mean), this.known, this.levels);
  }

  /** 1 at one of its own views, 0 far from all of them; by all four inputs. */
  support(distance: number): number {
    const least = this.near(distance).reduce((a, b) => Math.min(a, b), Infinity);
    return least < Infinity ? matern(least) : 0;
  }

  /** A distance by points, corrected by their errors in the label's views nearby; NaN stays NaN. */
  corrected(distance: number): number {
    let [sum, total] = [0, 0];
    for (let i = 0; i < this.corrections.length; i++) {
      const weight = matern(this.square(this.own[i] as number)) ** NEIGHBOUR_EXPONENT;
      sum += weight * (this.corrections[i] as number);
      total += weight;
    }
    return distance * Math.exp(sum / (total + HALF_WEIGHT));
  }

  /** The cell's pixels over those by its points, from the known views near by. */
  factor(): number {
    const { factors } = this;
    const { alike } = this.views;
    let [sum, total] = [HALF_WEIGHT * this.usual, HALF_WEIGHT];
    for (let view = 0; view < factors.length; view++) {
      const factor = factors[view] as number;
      if (factor < 0) continue;
      sum += (alike[view] as number) * factor;
      total += alike[view] as number;
    }
    return sum / total;
  }

  /** Squares of the scaled differences to its views. */
  private near(distance: number): Float64Array {
    const { own, scale, sent, views, logDistances } = this;
    const log = distance > 0 && distance < Infinity ? Math.log(distance) : sent.medianLogDistance;
    const near = new Float64Array(own.length);
    for (let i = 0; i < own.length; i++) {
      const view = own[i] as number;
      const further = log - (logDistances[i] as number);
      const seen = (views.rescaled[view] as number) * scale[2] + further * further * scale[3];
      near[i] = this.square(view) + seen;
    }
    return near;
  }

  /** Square of the scaled difference in place between the current viewpoint and a view. */
  private square(view: number): number {
    return (
      (this.views.away[view] as number) * this.scale[0] + (this.views.turned[view] as number) * this.scale[1]
    );
  }

  /** The weights by which the process has the values that were sent. */
  private solve(): Float64Array {
    const { own, scale, logDistances, sent } = this;
    const { rows } = this.views;
    const [a, b, c, d] = scale.map(Math.sqrt) as [number, number, number, number];
    const by = [a, a, a, b, b, b, c, c];
    const scaled = new Float64Array((COLUMNS + 1) * own.length);
    for (let i = 0, at = 0; i < own.length; i++) {
      const row = COLUMNS * (own[i] as number);
      for (const [j, factor] of by.entries()) scaled[at++] = (rows[row + j] as number) * factor;
      scaled[at++] = (logDistances[i] as number) * d;
    }
    return solved(covariance(scaled, own.length), valuesOf(sent), own.length);
  }
}

/** The viewpoint models of a label's cells, and what the label keeps. */
export class LabelModel {
  readonly cells: readonly CellModel[]; // as the label's, or one for all of them
  readonly whole: CellModel | null; // that one
  private readonly targets: Float64Array;
  private readonly thresholds: Float64Array;
  private readonly slopes: Float64Array;
  private readonly scale: readonly [number, number, number, number];

  constructor(
    label: Label,
    private readonly views: Views,
    private readonly sent: LabelPromises,
  ) {
    this.scale = scalesOf(sent);
    this.cells = ownModels(label, sent).map((own, i) => {
      const levels = own.id < 0 ? levelsOf(label) : (label.cells[i]?.levels.length ?? 0);
      return new CellModel(levels, views, own, this.scale);
    });
    this.whole = sent.cells.some(({ id }) => id < 0) ? (this.cells[0] ?? null) : null;
    this.targets = Float64Array.from(sent.targets, (target) => target * STEP);
    this.thresholds = Float64Array.from(sent.thresholds, (threshold) => threshold * STEP);
    this.slopes = Float64Array.from(sent.slopes, (slope) => slope * STEP);
  }

  /** Whether each cell has a model, or all have one, of levels that there are. */
  static fits(label: Label, sent: LabelPromises): boolean {
    const models = ownModels(label, sent);
    const most = (own: CellPromises, i: number) =>
      own.id < 0 ? levelsOf(label) : (label.cells[i]?.levels.length ?? 0);
    return (
      models.length > 0 &&
      models.every((own, i) =>
        (own.levels ?? [own.offsets.length]).every((level) => level <= most(own, i)),
      ) &&
      (models[0]?.id === -1 || models.length === label.cells.length)
    );
  }

  /**
   * What the label keeps at the viewpoint that the views are seen from.
   *
   * @param distance - of a label with one model for all cells; NaN: unknown
   */
  outlook(distance = Number.NaN): Outlook {
    const { sent, targets } = this;
    const support = this.whole?.support(distance) ?? this.support();
    const trust = support < sent.leastSupport ? "outside" : targets.length ? sent.status : "unknown";
    if (trust === "outside" || trust === "unknown") return { keeps: null, support, trust };
    const far = this.views.fromPhotos;
    return { keeps: { targets, needed: this.needed(Number.isNaN(far) ? 1 - support : far) }, support, trust };
  }

  /** Of models of cells, by all shared views, whichever cells they show. */
  private support(): number {
    const { views, scale } = this;
    let least = Infinity;
    for (let i = 0; i < views.away.length; i++) {
      const place = (views.away[i] as number) * scale[0] + (views.turned[i] as number) * scale[1];
      least = Math.min(least, place + (views.rescaled[i] as number) * scale[2]);
    }
    return least < Infinity ? matern(least) : 0;
  }

  /** The mean from which on each target is kept that far away: never less than for a lower one, at most 1. */
  private needed(away: number): Float64Array {
    let least = -Infinity;
    return this.thresholds.map((threshold, g) => {
      least = Math.max(least, threshold + (this.slopes[g] as number) * away);
      return 1 - (1 - Math.min(least, 1)) / this.views.strictness;
    });
  }
}

/** The models of the label's cells, in their order, as far as there are; or that of the label as a whole. */
function ownModels(label: Label, { cells }: LabelPromises): readonly CellPromises[] {
  const whole = cells.find(({ id }) => id < 0);
  if (whole) return [whole];
  const byId = new Map(cells.map((own) => [own.id, own]));
  return label.cells.flatMap(({ id }) => byId.get(id) ?? []);
}

/** Levels of a label: of the cell that has most. */
export const levelsOf = ({ cells }: Label): number => Math.max(0, ...cells.map((cell) => cell.levels.length));

/** The terms of a cell's levels, [J] of [K]: cosines over the ladder, times what is missing. */
function shapesOf(
  { terms = [], ladder = [] }: CellPromises,
  offsets: readonly number[],
  levels: number,
): Float64Array[] {
  return terms.map((_, j) =>
    Float64Array.from(offsets, (offset, k) => {
      const missing = offset < 1 ? Math.max(1 - offset, LEAST_MISSING) : 0;
      return missing * Math.cos((Math.PI * j * ((ladder[k] as number) - 0.5)) / levels);
    }),
  );
}

/** Values at the own views, by term or by level: those of levels are differences to the level below. */
function valuesOf({ values, units = [], terms = [] }: CellPromises): Float64Array {
  if (!values) return Float64Array.from(terms.flat(), (steps) => steps * VALUE_STEP);
  let level = new Array<number>(values[0]?.length ?? 0).fill(0); // whole numbers, so the sums are exact
  return Float64Array.from(
    values.flatMap((steps, k) => {
      level = level.map((below, i) => below + (steps[i] as number));
      return level.map((value) => value * (units[k] as number));
    }),
  );
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

/** Values of given levels (1-based) as an array over so many levels. */
function spread(values: readonly number[], levels: readonly number[], count: number): number[] {
  const out = new Array<number>(count).fill(Number.NaN);
  levels.forEach((level, i) => {
    if (level <= count) out[level - 1] = values[i] ?? Number.NaN;
  });
  return out;
}

const clip = (ssim: number): number => Math.min(Math.max(ssim, -1), 1);
const at = (values: ArrayLike<number>, i: number): number => values[i] as number;
