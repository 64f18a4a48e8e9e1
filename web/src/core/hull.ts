/** The steps by which a cell or label is upgraded with most gain per cost. */

/** A step from a level to a higher one, both from 0. */
export interface Segment {
  readonly row: number; // of the cell or label
  readonly from: number;
  readonly to: number;
  readonly slope: number; // gain per cost
  readonly more: number; // cost
  readonly gain: number;
}

/**
 * The step of most gain per cost from a level; null: none gains. Of equal slopes the one of less cost, then of more
 * gain, then the lower level.
 */
export function nextSegment(
  cost: readonly number[],
  value: readonly number[],
  from: number,
  row = 0,
): Segment | null {
  const [paid, had] = [cost[from] as number, value[from] as number];
  let [best, slope, more, gain] = [-1, 0, 0, 0];
  for (let to = from + 1; to < cost.length; to++) {
    const gained = (value[to] as number) - had;
    if (!(gained > 0)) continue;
    const costs = (cost[to] as number) - paid;
    const steep = costs > 0 ? gained / costs : Infinity;
    if (steep < slope) continue;
    if (steep > slope || (steep === slope && (costs < more || (costs === more && gained > gain)))) {
      [best, slope, more, gain] = [to, steep, costs, gained];
    }
  }
  return best < 0 ? null : { row, from, to: best, slope, more, gain };
}

/** The segments of the upper concave hull of value over cost, from a level on. */
export function hull(cost: readonly number[], value: readonly number[], from = 0, row = 0): Segment[] {
  const found: Segment[] = [];
  for (let next = nextSegment(cost, value, from, row); next; ) {
    found.push(next);
    next = nextSegment(cost, value, next.to, row);
  }
  return found;
}

/** All segments by falling slope; of equal ones the lower row first, and a row's own stay in order. */
export const steepest = (segments: Segment[]): Segment[] =>
  segments.sort((a, b) => (a.slope === b.slope ? a.row - b.row : b.slope - a.slope));
