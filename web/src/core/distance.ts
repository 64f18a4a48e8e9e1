/**
 * Distance and visibility of a label, by its bounding boxes. Same rules as src/sagesplat/viewer/boxes.py;
 * tests/data/distances.json checks both.
 */

import type { Box, Camera, Quat, Vec3, Viewpoint } from "../types";

/** A label as seen from a viewpoint. */
export interface Sight {
  readonly visible: boolean;
  readonly distance: number; // the bundle's units; NaN: unknown
  readonly size: number; // apparent size of its boxes, also out of sight: about its pixel share
}

type Plane = Viewpoint["frustum"][number];

const PERCENTILE = 0.05;
const AT = [1 / 6, 1 / 2, 5 / 6]; // sample positions along each axis of a box

/** Half width and half height of a picture at distance 1. */
export type Lens = readonly [number, number];

const LONGEST = 20 / 9; // of the sides of a picture that models know, the longer over the shorter

/**
 * The largest of the pictures that models know, by the photos' cameras: theirs, and those of other shapes and the
 * same area. Null without cameras. Same formula as `widest_lens` in src/sagesplat/adapt/observe.py.
 */
export function widestLens(cameras: readonly Camera[]): Lens | null {
  if (!cameras.length) return null;
  const largest = (side: "width" | "height", focal: 0 | 1) =>
    Math.max(...cameras.map((c) => Math.max(c[side] / c.intrinsics[focal], longest(c)))) / 2;
  return [largest("width", 0), largest("height", 1)];
}

const longest = ({ width, height, intrinsics: [fx, fy] }: Camera): number =>
  Math.sqrt((width * height * LONGEST) / (fx * fy));

/**
 * The frustum of a viewpoint, but no wider and no higher than a lens; the same one if it is not.
 * Models know distances in such pictures: a window that is higher also shows what lies at one's feet.
 */
export function photoFrustum(
  { position, direction, frustum }: Viewpoint,
  lens: Lens | null,
): readonly Plane[] {
  if (!lens || frustum.length < 4) return frustum; // left, right, bottom, top, ...
  const planes = frustum.map((plane, side) => {
    const limit = side < 4 ? lens[side < 2 ? 0 : 1] : Infinity;
    return narrowed(plane, position, direction, limit);
  });
  return planes.every((plane, side) => plane === frustum[side]) ? frustum : planes;
}

/** A side of a frustum at most `limit` from the axis, at distance 1. */
function narrowed(plane: Plane, position: Vec3, axis: Vec3, limit: number): Plane {
  const along = plane[0] * axis[0] + plane[1] * axis[1] + plane[2] * axis[2];
  const across = Math.sqrt(Math.max(0, 1 - along * along));
  if (!(along > limit * across)) return plane;
  const length = Math.hypot(1, limit);
  const turned = (i: 0 | 1 | 2) => ((plane[i] - along * axis[i]) / across + limit * axis[i]) / length;
  const n = [turned(0), turned(1), turned(2)] as const;
  return [...n, -(n[0] * position[0] + n[1] * position[1] + n[2] * position[2])];
}

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

/**
 * Distance of the visible boxes: approximates the 5th percentile over a label's points.
 *
 * @param photo - half spaces of `photoFrustum`, which decide the distance where anything is in them
 */
export function look(
  boxes: readonly Box[],
  { position, frustum }: Viewpoint,
  photo: readonly Plane[] = frustum,
): Sight {
  const near = boxes.filter((box) => touches(box, frustum));
  const visible = near.length > 0;
  let nearest = Infinity;
  let size = 0;
  for (const box of visible ? near : boxes) {
    const away = Math.sqrt(squareTo(position, middle(box, 0), middle(box, 1), middle(box, 2)));
    nearest = Math.min(nearest, away);
    size += Math.min(1, halfDiagonal(box) / Math.max(away, 1e-9)) ** 2 / boxes.length;
  }
  if (!visible) return { visible, distance: Number.NaN, size };
  const sampled = new Float64Array(near.length * AT.length ** 3);
  let found = 0;
  for (const planes of photo === frustum ? [frustum] : [photo, frustum]) {
    if (found) break;
    for (const box of near) {
      if (planes === frustum || touches(box, planes))
        found = sample(box, position, crossing(box, planes), sampled, found);
    }
  }
  return { visible, distance: found ? percentile(sampled.subarray(0, found)) : nearest, size };
}

/** Whether in each half space the deepest corner of a box is inside. */
export const touches = (box: Box, frustum: readonly Plane[]): boolean =>
  frustum.every((plane) => corner(box, plane, 3) >= 0);

/** The half spaces that do not contain the full box. */
const crossing = (box: Box, frustum: readonly Plane[]): Plane[] =>
  frustum.filter((plane) => corner(box, plane, 0) < 0);

/** Signed height over a plane of a box's highest (`of` 3) or lowest (0) corner. */
function corner(b: Box, plane: Plane, of: 0 | 3): number {
  let height = plane[3];
  for (let axis = 0; axis < 3; axis++) {
    const n = plane[axis] as number;
    height += n * (b[n < 0 ? axis + 3 - of : axis + of] as number);
  }
  return height;
}

/** Appends the squared distances of a box's samples in all half spaces; returns the new end. */
function sample(b: Box, from: Vec3, planes: readonly Plane[], into: Float64Array, start: number): number {
  let end = start;
  for (const i of AT) {
    const x = b[0] + i * (b[3] - b[0]);
    for (const j of AT) {
      const y = b[1] + j * (b[4] - b[1]);
      for (const k of AT) {
        const z = b[2] + k * (b[5] - b[2]);
        if (inside(x, y, z, planes)) into[end++] = squareTo(from, x, y, z);
      }
    }
  }
  return end;
}

function inside(x: number, y: number, z: number, planes: readonly Plane[]): boolean {
  for (const p of planes) if (p[0] * x + p[1] * y + p[2] * z + p[3] < 0) return false;
  return true;
}

const squareTo = (p: Vec3, x: number, y: number, z: number): number =>
  (x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2;

const middle = (b: Box, axis: number): number => ((b[axis] as number) + (b[axis + 3] as number)) / 2;

const halfDiagonal = (b: Box): number => Math.sqrt(squareTo([b[0], b[1], b[2]], b[3], b[4], b[5])) / 2;

/** Percentile of distances, given their squares, with linear interpolation. */
function percentile(squares: Float64Array): number {
  squares.sort();
  const rank = PERCENTILE * (squares.length - 1);
  const low = Math.sqrt(squares[Math.floor(rank)] as number);
  const high = Math.sqrt(squares[Math.ceil(rank)] as number);
  return low + (high - low) * (rank - Math.floor(rank));
}
