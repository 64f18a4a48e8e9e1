/**
 * Chooses a level per label: the cheapest that reaches a target, or the highest quality within a budget.
 * Same rules as src/sagesplat/adapt/allocate.py; tests/data/plans.json checks both.
 */

import { solveKnapsack, type Table, UNITS } from "./knapsack";

/** A level (from 0) per label. */
export interface Allocation {
  readonly levels: number[];
  readonly status: "ok" | "infeasible" | "over budget";
  readonly cost: number; // of the composition, in the unit of the costs
  readonly value: number; // sum of weight x quality
  readonly bound: number; // upper bound on the value of any composition within the budget
  readonly optimal: boolean;
  readonly missed: boolean[]; // labels with known bounds, none of which reaches the target
}

export interface Options {
  readonly weight?: readonly number[]; // per label
  readonly previous?: readonly number[]; // levels, -1: none
  readonly slack?: number; // hysteresis, SSIM: least gain of a change of level
  readonly states?: number; // limit of partial compositions; beyond it the plan may not be optimal
}

const SLACK = 0.01;
const STATES = 4096;

/** Quality without NaN, cost with Infinity for excluded levels, and which labels have known bounds. */
export interface Known {
  readonly q: number[][];
  readonly c: number[][];
  readonly promised: boolean[];
}

/** Resolves unknown qualities (NaN) and unavailable levels (cost Infinity). */
export function known(quality: Table, cost: Table): Known {
  const out: Known = { q: [], c: [], promised: [] };
  cost.forEach((row, label) => {
    const given = quality[label] ?? [];
    const knows = row.map((c, k) => c < Infinity && !Number.isNaN(at(given, k)));
    const promised = knows.includes(true);
    const largest = Math.max(1, ...row.map((c) => (c < Infinity ? c : 0)));
    const assumed = (c: number) => (c < Infinity ? Math.sqrt(c / largest) : 0);
    out.q.push(row.map((c, k) => (promised ? (knows[k] ? at(given, k) : 0) : assumed(c))));
    out.c.push(row.map((c, k) => (!promised || knows[k] ? c : Infinity)));
    out.promised.push(promised);
  });
  return out;
}

/**
 * Per label the cheapest level whose SSIM bound reaches `target`, else the best one ("infeasible").
 *
 * @param quality - SSIM by label and level, NaN: unknown
 * @param cost - integers, Infinity for an unavailable level; each label has an available one
 * @param target - SSIM of all labels or of each
 */
export function cheapest(
  quality: Table,
  cost: Table,
  target: number | readonly number[],
  options: Options = {},
): Allocation {
  const { q, c, promised } = known(quality, cost);
  const slack = options.slack ?? SLACK;
  const missed: boolean[] = [];
  const levels = q.map((row, label) => {
    const wanted = typeof target === "number" ? target : at(target, label);
    const best = reaching(row, c[label] ?? [], wanted, slack);
    missed.push(at2(promised, label) && !best.met);
    if (!at2(promised, label)) return best.highest;
    return hold(options.previous?.[label] ?? -1, best, row, c[label] ?? [], wanted, slack);
  });
  const { cost: total, value } = totals(levels, q, c, options.weight ?? q.map(() => 1));
  const status = missed.includes(true) ? "infeasible" : "ok";
  return { levels, status, cost: total, value, bound: value, optimal: true, missed };
}

/**
 * The levels with the largest sum of weight x SSIM whose cost is at most `budget`. If nothing fits, the
 * smallest composition, "over budget".
 *
 * @param budget - from 0 on, in the unit of the costs
 */
export function bestWithin(
  quality: Table,
  cost: Table,
  weight: readonly number[],
  budget: number,
  options: Options = {},
): Allocation {
  const { q, c } = known(quality, cost);
  const previous = options.previous ?? q.map(() => -1);
  const { slack = SLACK, states = STATES } = options;
  const best = solveKnapsack(q, c, weight, Math.floor(budget), previous, slack, states);
  const { cost: total, value } = totals(best.levels, q, c, weight);
  const all = weight.reduce((sum, w) => sum + w, 0);
  return {
    levels: best.levels,
    status: best.fits ? "ok" : "over budget",
    cost: total,
    value,
    bound: Math.max((best.bound / UNITS) * all, value),
    optimal: best.optimal,
    missed: q.map(() => false),
  };
}

interface Reaching {
  readonly wanted: number; // level without hysteresis
  readonly met: boolean; // whether it reaches the target
  readonly lower: number; // level to go down to, or -1
  readonly highest: number; // of the available levels
}

function reaching(q: readonly number[], c: readonly number[], target: number, slack: number): Reaching {
  const usable = c.map((cost) => cost < Infinity);
  const good = q.map((value, k) => at2(usable, k) && value >= target);
  const met = good.includes(true);
  const safely = target + Math.min(slack, (1 - target) / 2);
  const safe = q.map((value, k) => at2(usable, k) && value >= safely);
  const better = q.map((value) => -value);
  return {
    met,
    wanted: met ? first(good, c, better) : first(usable, better, c),
    lower: safe.includes(true) ? first(safe, c, better) : -1,
    highest: usable.lastIndexOf(true),
  };
}

function hold(
  previous: number,
  best: Reaching,
  q: readonly number[],
  c: readonly number[],
  target: number,
  slack: number,
): number {
  if (previous < 0 || !(at(c, previous) < Infinity)) return best.wanted;
  const before = at(q, previous);
  if (!(best.met ? before >= target : before >= at(q, best.wanted) - slack)) return best.wanted;
  const down = best.met && best.lower >= 0 && at(c, best.lower) < at(c, previous);
  return down ? best.lower : previous;
}

/** The allowed index with the smallest `key`, then `second`, then itself; 0 if none is allowed. */
function first(allowed: readonly boolean[], key: readonly number[], second: readonly number[]): number {
  let best = -1;
  allowed.forEach((is, k) => {
    if (!is) return;
    const less = at(key, k) - at(key, best) || at(second, k) - at(second, best);
    if (best < 0 || less < 0) best = k;
  });
  return Math.max(best, 0);
}

function totals(levels: readonly number[], q: Table, c: Table, weight: readonly number[]) {
  let cost = 0;
  let value = 0;
  levels.forEach((level, label) => {
    cost += at(c[label] ?? [], level);
    value += at(weight, label) * at(q[label] ?? [], level);
  });
  return { cost, value };
}

const at = (row: readonly number[], i: number): number => row[i] ?? Number.NaN;
const at2 = (row: readonly boolean[], i: number): boolean => row[i] ?? false;
