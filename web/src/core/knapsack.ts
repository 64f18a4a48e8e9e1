/**
 * The multiple-choice knapsack: one level per label, with the largest value within a budget. The method is
 * documented in src/sagesplat/adapt/knapsack.py; results are equal bit for bit.
 */

/** A matrix: a row per label, a column per level. */
export type Table = readonly (readonly number[])[];

/** Units of value in the total weight. */
export const UNITS = 2 ** 40;

export interface Solution {
  readonly levels: number[];
  readonly fits: boolean;
  readonly bound: number; // on the value, in units
  readonly optimal: boolean; // proven optimal
}

/** Cost and gain of levels relative to the label's cheapest one. */
interface Above {
  readonly floor: number[];
  readonly extra: number[][]; // Infinity: unavailable
  readonly gain: number[][];
  readonly room: number; // budget left after the cheapest levels
  readonly base: number; // value of the cheapest levels
}

/**
 * The best levels within a budget; rows of `q` and `c` (Infinity: unavailable) are labels.
 *
 * @param previous - levels that count as `slack` better, -1: none
 * @param states - limit of partial compositions, 0: greedy only
 */
export function solveKnapsack(
  q: Table,
  c: Table,
  weight: readonly number[],
  budget: number,
  previous: readonly number[],
  slack: number,
  states: number,
): Solution {
  const above = aboveFloor(q, c, weight, budget, previous, slack);
  const { floor, extra, gain, room, base } = above;
  if (room < 0) return { levels: floor, fits: false, bound: base, optimal: true };
  let { levels, critical } = greedy(above);
  let most = sum(gain, levels);
  if (critical === 0) return { levels, fits: true, bound: base + most, optimal: true };
  const stay = floor.map((level, label) => {
    const before = num(previous, label);
    return before >= 0 && num(row(extra, label), before) < Infinity ? before : level;
  });
  if (sum(extra, stay) <= room && sum(gain, stay) >= most) {
    levels = stay;
    most = sum(gain, stay);
  }
  const { exact, bound } = front(above, critical, most, states);
  if (exact) return { levels: exact, fits: true, bound: base + sum(gain, exact), optimal: true };
  return { levels, fits: true, bound: base + bound, optimal: false };
}

function aboveFloor(
  q: Table,
  c: Table,
  weight: readonly number[],
  budget: number,
  previous: readonly number[],
  slack: number,
): Above {
  const total = weight.reduce((all, w) => all + w, 0);
  let room = budget;
  let base = 0;
  const floor: number[] = [];
  const gain = q.map((values, label) => {
    const costs = row(c, label);
    const units = total > 0 ? (num(weight, label) / total) * UNITS : 0;
    const gains = values.map((value, k) => {
      const kept = k === previous[label] ? value + slack : value;
      return num(costs, k) < Infinity ? Math.floor(units * kept + 0.5) : 0;
    });
    const least = cheapestOf(values, costs, gains);
    floor.push(least);
    room -= num(costs, least);
    base += num(gains, least);
    return gains.map((g) => g - num(gains, least));
  });
  const extra = gain.map((gains, label) => {
    const costs = row(c, label);
    const least = num(floor, label);
    return gains.map((g, k) => {
      const more = num(costs, k) - num(costs, least);
      return k === least || (g > 0 && more <= room) ? more : Infinity;
    });
  });
  return { floor, extra, gain, room, base };
}

/** The cheapest level; ties by larger gain, then higher quality, then lower index. */
function cheapestOf(values: readonly number[], costs: readonly number[], gains: readonly number[]): number {
  let best = -1;
  costs.forEach((cost, k) => {
    if (!(cost < Infinity)) return;
    const order =
      cost - num(costs, best) || num(gains, best) - num(gains, k) || num(values, best) - num(values, k);
    if (best < 0 || order < 0) best = k;
  });
  return best;
}

interface Step {
  readonly to: number;
  readonly slope: number; // gain per cost
  readonly more: number; // cost
}

const NONE: Step = { to: -1, slope: 0, more: 0 };

/** The level above a given one with the largest gain per cost; ties by lower cost. */
function step(extra: readonly number[], gain: readonly number[], from: number, limit: number): Step {
  let best = NONE;
  for (let k = 0; k < extra.length; k++) {
    const more = num(extra, k) - num(extra, from);
    if (!(num(gain, k) > num(gain, from) && more <= limit)) continue;
    const slope = (num(gain, k) - num(gain, from)) / more;
    if (slope > best.slope || (slope === best.slope && more < best.more)) best = { to: k, slope, more };
  }
  return best;
}

/** Greedy levels by gain per cost; also the gain per cost of the first step that does not fit, else 0. */
function greedy({ floor, extra, gain, room }: Above): { levels: number[]; critical: number } {
  const levels = [...floor];
  const steps = floor.map((from, label) => step(row(extra, label), row(gain, label), from, room));
  let left = room;
  let critical = 0;
  while (levels.length) {
    let best = 0;
    let next = steps[0] ?? NONE;
    steps.forEach((s, label) => {
      if (s.slope > next.slope || (s.slope === next.slope && s.more < next.more)) {
        best = label;
        next = s;
      }
    });
    if (next.slope === 0) break;
    if (next.more <= left) {
      levels[best] = next.to;
      left -= next.more;
    } else if (critical === 0) {
      critical = next.slope;
    }
    const limit = critical > 0 ? left : Infinity; // until then the steps follow the convex hull
    steps[best] = step(row(extra, best), row(gain, best), num(levels, best), limit);
  }
  return { levels, critical };
}

/** Partial compositions as a tree: each has a parent, and the level of one more label. */
interface States {
  readonly parent: Int32Array;
  readonly choice: Int32Array;
  readonly cost: Float64Array;
  readonly gain: Float64Array;
}

/** Whether a partial composition has the lower level at the first label where two differ. */
function before({ parent, choice }: States, a: number, b: number): boolean {
  let lower = false;
  let [x, y] = [a, b];
  while (x !== y) {
    const [one, other] = [choice[x] as number, choice[y] as number];
    if (one !== other) lower = one < other;
    [x, y] = [parent[x] as number, parent[y] as number];
  }
  return lower;
}

/** The optimal levels, null beyond the limit of states; and the Lagrangian bound on their gain. */
function front(
  { extra, gain, room }: Above,
  slope: number,
  least: number,
  limit: number,
): { exact: number[] | null; bound: number } {
  const L = extra.length;
  const rest = new Array<number>(L + 1).fill(0); // largest contribution of the labels from here on at that price
  for (let label = L - 1; label >= 0; label--) {
    const reduced = row(gain, label).map((g, k) => g - slope * num(row(extra, label), k));
    rest[label] = num(rest, label + 1) + Math.max(...reduced);
  }
  const bound = num(rest, 0) + slope * room;
  const states: States = {
    parent: new Int32Array(limit + 1),
    choice: new Int32Array(limit + 1),
    cost: new Float64Array(limit + 1),
    gain: new Float64Array(limit + 1),
  };
  let begin = 0;
  let end = 1;
  for (let label = 0; label < L; label++) {
    // tolerance of rounding: one unit per label is ample
    const needed = least - L - slope * room - num(rest, label + 1);
    const allowed = Math.floor((limit * (label + 1)) / L);
    const to = merge(states, row(extra, label), row(gain, label), {
      begin,
      end,
      room,
      slope,
      needed,
      allowed,
    });
    if (to < 0) return { exact: null, bound };
    [begin, end] = [end, to];
  }
  if (begin === end) return { exact: null, bound };
  const levels = new Array<number>(L).fill(0);
  let at = end - 1;
  for (let label = L - 1; label >= 0; label--) {
    levels[label] = states.choice[at] as number;
    at = states.parent[at] as number;
  }
  return { exact: levels, bound };
}

interface Merge {
  readonly begin: number; // of the current front
  readonly end: number;
  readonly room: number;
  readonly slope: number;
  readonly needed: number;
  readonly allowed: number; // limit of states
}

/** Appends the Pareto front with one more label, ascending in cost and gain; its end, -1 beyond the limit. */
function merge(s: States, extra: readonly number[], gain: readonly number[], m: Merge): number {
  const heads = new Int32Array(extra.length).fill(m.begin);
  let n = m.end;
  for (;;) {
    let best = -1;
    let cost = 0;
    let most = 0;
    for (let k = 0; k < extra.length; k++) {
      while ((heads[k] as number) < m.end) {
        const head = heads[k] as number;
        const c = (s.cost[head] as number) + (extra[k] as number);
        const g = (s.gain[head] as number) + (gain[k] as number);
        if (c > m.room) {
          heads[k] = m.end;
        } else if ((n > m.end && g <= (s.gain[n - 1] as number)) || g - m.slope * c < m.needed) {
          heads[k] = head + 1;
        } else {
          if (best < 0 || c < cost || (c === cost && g > most)) {
            [best, cost, most] = [k, c, g];
          } else if (c === cost && g === most && before(s, head, heads[best] as number)) {
            best = k;
          }
          break;
        }
      }
    }
    if (best < 0) return n;
    if (n > m.allowed) return -1;
    s.parent[n] = heads[best] as number;
    s.choice[n] = best;
    s.cost[n] = cost;
    s.gain[n] = most;
    heads[best] = (heads[best] as number) + 1;
    n += 1;
  }
}

function sum(table: Table, levels: readonly number[]): number {
  let total = 0;
  for (let label = 0; label < levels.length; label++) total += num(row(table, label), num(levels, label));
  return total;
}

const num = (values: readonly number[], i: number): number => values[i] as number;
const row = (table: Table, i: number): readonly number[] => table[i] as readonly number[];
