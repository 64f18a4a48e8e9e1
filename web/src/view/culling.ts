/** Which cells are drawn: those whose splats the frustum meets, or would soon. */

import { type Encoding, half, scalesOf } from "../core/pick";
import type { Box, Viewpoint } from "../types";

type Plane = Viewpoint["frustum"][number];
type Planes = readonly Plane[];

const REACH = 3.33; // standard deviations, as splats are drawn
const SOON = 0.15; // radians beyond the frustum from which on a cell has to be drawn
const FAR = 0.35; // the same up to which cells are drawn
const WASTE = 0.2; // part of the drawn splats beyond that, from which on they are left out

/** A cell that is drawn, or not. */
export interface Drawable {
  readonly bounds: Box | null; // of its splats; null: it has none yet
  readonly count: number; // splats
  readonly drawn: boolean;
}

/**
 * Whether each cell is drawn from now on. Sorting takes a few frames, so cells are drawn before they come into
 * sight, and as seldom as can be another set of them.
 */
export function drawnCells(cells: readonly Drawable[], view: Viewpoint): boolean[] {
  const [soon, far] = [widened(view, SOON), widened(view, FAR)];
  const near = cells.map(({ bounds }) => !bounds || touches(bounds, far));
  const isMissing = cells.some(
    ({ bounds, drawn }, i) => near[i] && !drawn && bounds && touches(bounds, soon),
  );
  const sum = (of: (cell: Drawable, i: number) => boolean) =>
    cells.reduce((total, cell, i) => total + (of(cell, i) ? cell.count : 0), 0);
  const waste = sum(({ drawn }, i) => drawn && !near[i]);
  if (isMissing || waste > WASTE * sum(({ drawn }) => drawn)) return near;
  return cells.map(({ drawn }) => drawn);
}

/** The bounds of splats as far as they are drawn; of none: null. */
export function boundsOf(words: Uint32Array, count: number, encoding: Encoding): Box | null {
  if (!count) return null;
  const scales = scalesOf(encoding);
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let at = 0; at < 4 * count; at += 4) {
    const [xy, z, sizes] = [words[at + 1] as number, words[at + 2] as number, words[at + 3] as number];
    const reach =
      REACH * (scales[Math.max(sizes & 255, (sizes >>> 8) & 255, (sizes >>> 16) & 255)] as number);
    const place = [half(xy), half(xy >>> 16), half(z)];
    for (let axis = 0; axis < 3; axis++) {
      const centre = place[axis] as number;
      if (centre - reach < (low[axis] as number)) low[axis] = centre - reach;
      if (centre + reach > (high[axis] as number)) high[axis] = centre + reach;
    }
  }
  return [...low, ...high] as unknown as Box;
}

/** The bounds of both. */
export function joinedBounds(a: Box | null, b: Box | null): Box | null {
  if (!a || !b) return a ?? b;
  return a.map((value, i) => (i < 3 ? Math.min : Math.max)(value, b[i] as number)) as unknown as Box;
}

/** Whether in each half space the deepest corner of a box is inside. */
export const touches = (box: Box, planes: Planes): boolean =>
  planes.every((plane) => {
    let height = plane[3];
    for (let axis = 0; axis < 3; axis++) {
      const n = plane[axis] as number;
      height += n * (box[n < 0 ? axis : axis + 3] as number);
    }
    return height >= 0;
  });

/** The frustum with its sides turned outwards by an angle, to a half space at most. */
function widened({ position, direction, frustum }: Viewpoint, angle: number): Plane[] {
  return frustum.map((plane) => {
    const [x, y, z, d] = plane;
    const along = x * direction[0] + y * direction[1] + z * direction[2];
    const across = Math.sqrt(Math.max(0, 1 - along * along));
    if (across < 1e-6) return plane;
    const turn = Math.min(angle, Math.atan2(across, along));
    const [a, b] = [Math.cos(turn) - (along / across) * Math.sin(turn), Math.sin(turn) / across];
    const n = [a * x + b * direction[0], a * y + b * direction[1], a * z + b * direction[2]] as const;
    const height = (m: readonly number[]) =>
      (m[0] as number) * position[0] + (m[1] as number) * position[1] + (m[2] as number) * position[2];
    return [...n, d + height(plane) - height(n)] as const;
  });
}
