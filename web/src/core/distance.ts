/**
 * How a viewpoint sees a cell, by a few points that stand for its Gaussians. Same formulas as
 * src/sagesplat/adapt/cells.py; tests/data/promises.json checks both.
 */

import type { Cell, Quat, Vec3, Viewpoint } from "../types";

/** A cell as seen from a viewpoint. */
export interface Sight {
  readonly visible: boolean;
  readonly distance: number; // the bundle's units; NaN: out of sight
  readonly apparent: number; // about its share of the pixels if nothing hid it; 0: out of sight
  readonly potential: number; // what `apparent` would be if all of it were in sight
}

const PERCENTILE = 0.25; // of a cell's distances
const LABEL_PERCENTILE = 0.05; // of those of a label as a whole
const STEPS = 255; // of positions within the bounds
const NEAREST = 1e-9;

/** A vector rotated by a quaternion x y z w of any length. */
export function rotate(q: Quat, v: Vec3): Vec3 {
  const length = Math.hypot(...q);
  const [x, y, z, w] = q.map((part) => part / length) as unknown as Quat;
  const cross = (a: Vec3): Vec3 => [y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0]];
  const once = cross(v);
  const twice = cross(once);
  return [
    v[0] + 2 * (w * once[0] + twice[0]),
    v[1] + 2 * (w * once[1] + twice[1]),
    v[2] + 2 * (w * once[2] + twice[2]),
  ];
}

/** The points of a cell, and how far they are from the viewpoint that looked last. */
export class Points {
  readonly rows: Float64Array; // [n, 4] x y z area
  private readonly radius: number;
  private readonly distances: Float64Array; // [n]
  private readonly weights: Float64Array; // [n] area in sight

  constructor({ bounds, points: packed, area, radius }: Cell) {
    const points = Uint8Array.from(atob(packed), (byte) => byte.charCodeAt(0));
    const n = points.length / 4;
    this.radius = Math.max(radius, NEAREST);
    this.rows = new Float64Array(points.length);
    this.distances = new Float64Array(n);
    this.weights = new Float64Array(n);
    let total = 0;
    for (let i = 3; i < points.length; i += 4) total += points[i] as number;
    for (let i = 0; i < points.length; i += 4) {
      for (let axis = 0; axis < 3; axis++) {
        const low = bounds[axis] as number;
        const part = (points[i + axis] as number) / STEPS;
        this.rows[i + axis] = low + part * ((bounds[axis + 3] as number) - low);
      }
      this.rows[i + 3] = (area * (points[i + 3] as number)) / Math.max(total, 1);
    }
  }

  look({ position, frustum, lens }: Viewpoint): Sight {
    const { rows, radius, distances, weights } = this;
    const [px, py, pz] = position;
    let [solid, whole] = [0, 0];
    for (let i = 0, at = 0; at < rows.length; i++, at += 4) {
      const [x, y, z] = [rows[at] as number, rows[at + 1] as number, rows[at + 2] as number];
      const area = rows[at + 3] as number;
      let height = Infinity;
      for (const p of frustum) height = Math.min(height, p[0] * x + p[1] * y + p[2] * z + p[3]);
      const inside = Math.min(Math.max(0.5 + height / (2 * radius), 0), 1);
      const square = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2;
      const away = Math.max(Math.sqrt(square), NEAREST);
      distances[i] = away;
      weights[i] = area * inside;
      whole += area / away ** 2;
      solid += (area * inside) / away ** 2;
    }
    const unit = 1 / (4 * lens[0] * lens[1]);
    const distance = solid > 0 ? percentile([this], PERCENTILE) : Number.NaN;
    return { visible: solid > 0, distance, apparent: unit * solid, potential: unit * whole };
  }

  /** Distance of a label as a whole, whose cells have looked; NaN: out of sight. */
  static together(cells: readonly Points[]): number {
    return percentile(cells, LABEL_PERCENTILE);
  }

  /** Appends its points in sight as distance and weight. */
  append(into: [number, number][]): void {
    for (let i = 0; i < this.weights.length; i++) {
      const weight = this.weights[i] as number;
      if (weight > 0) into.push([this.distances[i] as number, weight]);
    }
  }
}

/** The first distance up to which there is this part of the weights; NaN without any. */
function percentile(cells: readonly Points[], part: number): number {
  const all: [number, number][] = [];
  for (const cell of cells) cell.append(all);
  all.sort((a, b) => a[0] - b[0]);
  const total = all.reduce((sum, [, weight]) => sum + weight, 0);
  let sum = 0;
  for (const [distance, weight] of all) {
    sum += weight;
    if (sum >= part * total) return distance;
  }
  return Number.NaN;
}
