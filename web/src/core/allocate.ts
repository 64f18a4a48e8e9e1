/**
 * The cheapest levels that reach a target: of a label as a whole, or of its cells together. Same rules as
 * src/sagesplat/adapt/allocate.py; tests/data/plans.json checks both.
 */

import { climb } from "./hull";

/** A matrix: a row per cell or label, a column per level. */
export type Table = readonly (readonly number[])[];

/** A level (from 0) per label. */
export interface Allocation {
  readonly levels: number[];
  readonly status: "ok" | "infeasible";
  readonly missed: boolean[]; // labels with known bounds, none of which reaches the target
}

export interface Options {
  readonly previous?: readonly number[]; // levels, -1: none
  readonly slack?: number; // hysteresis, SSIM: least gain of a change of level
}

const SLACK = 0.01;

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

/** Cells of one label that are in sight. */
export interface Cells {
  readonly cost: Table;
  readonly mean: Table; // never falling
  readonly share: readonly number[]; // of the pixels
  readonly previous?: readonly number[]; // levels, -1: none
}

const ROUNDING = 1e-9; // of what is reached
const SAVING = 0.1; // least part of the bytes that makes a label leave its earlier levels

/**
 * The cheapest levels, from 0, by which the mean over a label's pixels reaches what is needed; those of the best
 * quality if none do ("infeasible").
 */
export function together(cells: Cells, needed: number): { levels: number[]; status: Allocation["status"] } {
  const { cost, mean, share, previous } = cells;
  if (!(needed < 1)) {
    return { levels: cost.map((row) => row.length - 1), status: needed > 1 ? "infeasible" : "ok" };
  }
  const levels = cost.map(() => 0);
  const value = mean.map((row, i) => row.map((q) => (share[i] ?? 0) * q));
  const goal = needed * share.reduce((sum, s) => sum + s, 0) - ROUNDING;
  let reached = total(value, levels);
  climb(cost, value, levels, ({ row, to, gain }) => {
    if (reached >= goal) return false;
    levels[row] = to;
    reached += gain;
    return true;
  });
  if (reached < goal) {
    const best = mean.map((row) => Math.max(0, row.indexOf(Math.max(...row))));
    return { levels: best, status: "infeasible" };
  }
  const before = previous?.every((level, i) => level >= 0 && level < (cost[i]?.length ?? 0))
    ? previous
    : null;
  const holds =
    before &&
    total(value, before) >= goal &&
    total(cost, before) - total(cost, levels) < SAVING * total(cost, before);
  return { levels: holds ? [...before] : levels, status: "ok" };
}

/** Sum over the cells at these levels. */
const total = (table: Table, levels: readonly number[]): number =>
  table.reduce((sum, row, i) => sum + at(row, levels[i] ?? 0), 0);

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
  return { levels, status: missed.includes(true) ? "infeasible" : "ok", missed };
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

const at = (row: readonly number[], i: number): number => row[i] ?? Number.NaN;
const at2 = (row: readonly boolean[], i: number): boolean => row[i] ?? false;
