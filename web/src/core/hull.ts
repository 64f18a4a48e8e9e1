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
 * The segment of the upper concave hull of value over cost from a level on; null: none gains. Of equal slopes the one of less cost, then of more
 * gain, then the lower level.
 */
export function nextSegment(
  cost: readonly number[],
  value: readonly number[],
  from: number,
  row = 0,
): Segment | null {
  const paid = cost[from] as number;
  const had = value[from] as number;
  let best = -1;
  let slope = 0;
  let more = 0;
  let gain = 0;
  for (let to = from + 1; to < cost.length; to++) {
    const gained = (value[to] as number) - had;
    if (!(gained > 0)) continue;
    const costs = (cost[to] as number) - paid;
    const steep = costs > 0 ? gained / costs : Infinity;
    if (steep < slope) continue;
    if (steep > slope || (steep === slope && (costs < more || (costs === more && gained > gain)))) {
      best = to;
      slope = steep;
      more = costs;
      gain = gained;
    }
  }
  return best < 0 ? null : { row, from, to: best, slope, more, gain };
}

/**
 * Offers the rows' segments by falling slope; of equal ones the lower row's come first. A row goes on from a segment
 * that is taken, and stays where one is not.
 */
export function climb(
  cost: readonly (readonly number[])[],
  value: readonly (readonly number[])[],
  from: readonly number[],
  take: (segment: Segment) => boolean,
): void {
  const next = (row: number, level: number) => nextSegment(cost[row] ?? [], value[row] ?? [], level, row);
  // a heap, the steepest on top: most segments of a large scene are never asked for
  const heap = cost.flatMap((_, row) => next(row, from[row] ?? 0) ?? []);
  for (let i = heap.length >> 1; i >= 0; i--) sink(heap, i);
  for (let top = heap[0]; top; top = heap[0]) {
    const after = take(top) ? next(top.row, top.to) : null;
    const last = after ?? (heap.pop() as Segment);
    if (heap.length) heap[0] = last;
    sink(heap, 0);
  }
}

function sink(heap: Segment[], from: number): void {
  const item = heap[from];
  if (!item) return;
  let at = from;
  for (;;) {
    let child = 2 * at + 1;
    const [left, right] = [heap[child], heap[child + 1]];
    if (!left) break;
    if (right && precedes(right, left)) child += 1;
    const better = heap[child] as Segment;
    if (!precedes(better, item)) break;
    heap[at] = better;
    at = child;
  }
  heap[at] = item;
}

const precedes = (a: Segment, b: Segment): boolean =>
  a.slope > b.slope || (a.slope === b.slope && a.row < b.row);
