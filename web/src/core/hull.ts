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
 * The segments of the upper concave hull of value over cost, from a level on. Of equal slopes the one of less
 * cost, then of more gain, then the lower level.
 */
export function hull(cost: readonly number[], value: readonly number[], from = 0, row = 0): Segment[] {
  const found: Segment[] = [];
  for (let level = from; level >= 0; ) {
    let best: Segment = { row, from: level, to: -1, slope: 0, more: 0, gain: 0 };
    for (let to = level + 1; to < cost.length; to++) {
      const more = (cost[to] as number) - (cost[level] as number);
      const gain = (value[to] as number) - (value[level] as number);
      if (!(gain > 0)) continue;
      const slope = more > 0 ? gain / more : Infinity;
      const better = more < best.more || (more === best.more && gain > best.gain);
      if (slope > best.slope || (slope === best.slope && better)) {
        best = { row, from: level, to, slope, more, gain };
      }
    }
    if (best.to >= 0) found.push(best);
    level = best.to;
  }
  return found;
}

/** All segments by falling slope; of equal ones the lower row first, and a row's own stay in order. */
export const steepest = (segments: Segment[]): Segment[] =>
  segments.sort((a, b) => (a.slope === b.slope ? a.row - b.row : b.slope - a.slope));
