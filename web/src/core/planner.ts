/** Plans the level of each cell from settings and a viewpoint. Levels are 1-based, 0 is nothing. */

import type { Budget, Level, Settings } from "../types";
import { cheapest, together } from "./allocate";
import { fill } from "./fill";
import { climb, nextSegment, type Segment } from "./hull";

/** The planner's input for a cell, or for a label all of whose cells have one level. */
export interface Candidate {
  readonly ladder: Ladder;
  readonly effort: readonly number[]; // by level, bytes, of which those that are there count a part
  readonly highest: number; // highest available level; lower if an increment is damaged
  readonly mean: readonly number[]; // by level, quality; NaN: unknown
  readonly weight: number; // of the label, set by the user
  readonly always: boolean; // in full
  readonly share: number; // pixel share; 0: out of sight
  readonly potential: number; // apparent size if all of it were in sight
  readonly visible: boolean;
  readonly previous: number; // level in the previous plan, 0: none
}

/** The cells of a label, and what it takes to reach the target. */
export interface Group {
  readonly cells: readonly Candidate[];
  readonly needed: number; // mean quality over its pixels; NaN: no promise is possible
  readonly bound?: readonly number[]; // by level, of a label that is planned as a whole; instead of `needed`
}

/** Total costs of the levels of a cell. */
export interface Ladder {
  readonly bytes: readonly number[];
  readonly gpuBytes: readonly number[];
  readonly count: readonly number[];
}

export interface Plan {
  readonly wanted: readonly (readonly number[])[]; // level by group and cell
  readonly around: readonly (readonly number[])[]; // that which follows once everything in sight is drawn
  readonly status: "ok" | "infeasible" | "over budget";
}

const UNITS = ["bytes", "gpuBytes", "count"] as const;
type Unit = (typeof UNITS)[number];
/** Least pixel share of a cell in sight: it may be there though it was hidden in all known views. */
export const LEAST_SHARE = 1e-4;
const SLACK = 0.01; // least gain of quality for which a budget's levels are left

/**
 * Costs of levels as sums over their increments, from the newest that replaces those below.
 *
 * @param palette - bytes of the cell's part in one, which the levels from the last that replaces on need
 */
export function ladderOf({ levels }: { readonly levels: readonly Level[] }, palette = 0): Ladder {
  const first = Math.max(
    levels.findLastIndex(({ refine }) => refine),
    0,
  );
  const sums = (unit: Unit) => {
    let sum = 0;
    return levels.map((level) => {
      sum = level[unit] + (level.refine ? 0 : sum);
      return sum;
    });
  };
  const bytes = sums("bytes").map((sum, k) => (k < first ? sum : sum + palette));
  return { bytes, gpuBytes: sums("gpuBytes"), count: sums("count") };
}

/** Weight of a cell at this viewpoint. */
export const visibleWeight = (c: Candidate): number => (c.visible ? c.weight * c.share : 0);

/** The same, as if the cell were in sight. */
export const potentialWeight = (c: Candidate): number => c.weight * Math.max(c.potential, LEAST_SHARE);

/** A cell while it is planned. */
interface Row {
  readonly c: Candidate;
  level: number; // from 0; -1: left out
}

/** The planned levels, within the budget in all units; the smallest composition if nothing fits. */
export function makePlan(groups: readonly Group[], settings: Settings): Plan {
  const all = groups.map(({ cells }) =>
    cells.map((c): Row => ({ c, level: c.highest > 0 ? (c.always ? c.highest - 1 : 0) : -1 })),
  );
  leaveOut(all.flat(), settings.budget);
  const there = all.flat().filter(({ level }) => level >= 0);
  const free = there.filter(({ c }) => !c.always);
  const left = lessen(
    settings.budget,
    there.filter(({ c }) => c.always),
  );
  const status = choose(groups, all, free, settings, left);
  const listed = () => all.map((rows) => rows.map(({ level }) => level + 1));
  const wanted = listed();
  raise(free, settings, left);
  return { wanted, around: listed(), status };
}

/** Leaves out cells out of sight where not even the lowest levels fit, those of least apparent size first. */
function leaveOut(rows: readonly Row[], budget: Budget): void {
  const over = lessen(budget, rows);
  if (!isOver(over)) return;
  const unseen = rows.filter(({ c, level }) => level >= 0 && !c.visible && !c.always);
  for (const row of unseen.sort((a, b) => potentialWeight(a.c) - potentialWeight(b.c))) {
    if (!isOver(over)) return;
    for (const unit of UNITS) over[unit] += row.c.ladder[unit][0] ?? 0;
    row.level = -1;
  }
}

/** Raises the levels of the free rows, which are the lowest, by the settings. */
function choose(
  groups: readonly Group[],
  all: readonly (readonly Row[])[],
  free: readonly Row[],
  settings: Settings,
  budget: Budget,
): Plan["status"] {
  const { mode } = settings;
  if (mode === "budget") return within(free, budget);
  const asked = mode === "target" ? reach(groups, all, settings) : "ok";
  if (mode === "full") for (const row of free) row.level = row.c.highest - 1;
  if (!isOver(lessen(budget, free))) return asked;
  for (const row of free) row.level = 0;
  const status = within(free, budget);
  return status === "ok" ? "infeasible" : status;
}

/**
 * The levels that reach a target with the least effort; the first level out of sight. For a target of fidelity the picture
 * as a whole is not to be worse than equal levels of all cells would be for the same bytes.
 */
function reach(
  groups: readonly Group[],
  all: readonly (readonly Row[])[],
  { quality, target }: Settings,
): Plan["status"] {
  let status: Plan["status"] = "ok";
  const seen: Row[] = [];
  groups.forEach(({ needed, bound }, i) => {
    const rows = (all[i] ?? []).filter(({ c, level }) => !c.always && level >= 0 && visibleWeight(c) > 0);
    if (!rows.length) return;
    seen.push(...rows);
    const cost = rows.map(({ c }) => effortOf(c));
    const previous = rows.map(({ c }) => before(c));
    const isKnown = !Number.isNaN(needed) && rows.every(({ c }) => c.mean.some((q) => !Number.isNaN(q)));
    const found = bound
      ? cheapest([bound.slice(0, rows[0]?.c.highest)], cost, target, { previous })
      : together(
          { cost, mean: rows.map(({ c }) => qualityOf(c)), share: rows.map(({ c }) => c.share), previous },
          isKnown ? needed : 1,
        );
    if (found.status !== "ok") status = "infeasible";
    rows.forEach((row, k) => {
      row.level = found.levels[k] ?? 0;
    });
  });
  if (quality !== "fidelity") return status;
  const filled = fill(
    seen.map(({ level }) => level),
    seen.map(({ c }) => c.mean),
    seen.map(({ c }) => effortOf(c)),
    seen.map(({ c }) => visibleWeight(c)),
  );
  seen.forEach((row, i) => {
    row.level = filled[i] ?? 0;
  });
  return status;
}

/**
 * Upgrades by falling gain per cost, each taken if it still fits in every unit. The cost is the largest part of
 * the budgets.
 */
function within(free: readonly Row[], budget: Budget): Plan["status"] {
  const left = lessen(budget, free);
  if (isOver(left)) return "over budget";
  const seen = free.filter(({ c }) => visibleWeight(c) > 0);
  const values = seen.map(({ c }) => {
    const weight = visibleWeight(c);
    return qualityOf(c).map((quality) => weight * quality);
  });
  const scale = UNITS.map((unit) => 1 / Math.max(budget[unit], 1));
  const [bytes = 0, gpuBytes = 0, count = 0] = scale;
  const costs = seen.map(({ c: { ladder } }, i) =>
    (values[i] ?? []).map((_, k) =>
      Math.max(
        bytes * (ladder.bytes[k] ?? 0),
        gpuBytes * (ladder.gpuBytes[k] ?? 0),
        count * (ladder.count[k] ?? 0),
      ),
    ),
  );
  const levels = seen.map(({ level }) => level);
  climb(costs, values, levels, (segment) => take(seen[segment.row] as Row, segment, left));
  // earlier levels that are about as good stay
  const earlier = seen.map(({ c }) => ({ c, level: before(c) }));
  const value = (rows: readonly Row[]) =>
    rows.reduce((sum, { level }, i) => sum + (values[i]?.[level] ?? Number.NaN), 0);
  const slack = SLACK * seen.reduce((sum, { c }) => sum + visibleWeight(c), 0);
  if (!(value(earlier) >= value(seen) - slack)) return "ok";
  const unseen = free.filter(({ c }) => visibleWeight(c) <= 0);
  if (isOver(lessen(budget, [...earlier, ...unseen]))) return "ok";
  seen.forEach((row, i) => {
    row.level = earlier[i]?.level ?? 0;
  });
  return "ok";
}

/** Takes a row's next segment, if it fits into what is left, which it lessens; whether it did. */
function take(row: Row, { from, to }: Segment, left: Costs): boolean {
  const { ladder } = row.c;
  const more = (unit: Unit) => (ladder[unit][to] as number) - (ladder[unit][from] as number);
  if (UNITS.some((unit) => more(unit) > left[unit])) return false;
  for (const unit of UNITS) left[unit] -= more(unit);
  row.level = to;
  return true;
}

/** Raises cells out of sight, the largest first, by a segment at a time. */
function raise(free: readonly Row[], { mode, aroundBytes }: Settings, budget: Budget): void {
  const left = lessen(budget, free);
  if (mode === "full" || mode === "base" || !(aroundBytes > 0) || isOver(left)) return;
  left.bytes = Math.min(left.bytes, aroundBytes);
  let rows = free.filter(({ c }) => !c.visible && c.weight > 0).sort((a, b) => b.c.potential - a.c.potential);
  while (rows.length) {
    rows = rows.filter((row) => {
      const next = nextSegment(bytesOf(row.c), qualityOf(row.c), row.level);
      return next && take(row, next, left);
    });
  }
}

/** Expected quality by available level: an unknown one as the one below, by the bytes if all are. */
function qualityOf({ mean, ladder, highest }: Candidate): readonly number[] {
  const some = highest < mean.length ? mean.slice(0, highest) : mean;
  if (!some.some(Number.isNaN)) return some;
  const most = ladder.bytes[highest - 1] ?? 1;
  if (some.every(Number.isNaN)) return some.map((_, k) => Math.sqrt((ladder.bytes[k] ?? 0) / most));
  let last = 0;
  return some.map((quality) => {
    if (!Number.isNaN(quality)) last = quality;
    return last;
  });
}

const before = (c: Candidate): number => (c.previous <= c.highest ? c.previous - 1 : -1);

/** By available level. */
const upTo = (highest: number, costs: readonly number[]): readonly number[] =>
  highest < costs.length ? costs.slice(0, highest) : costs;

const bytesOf = ({ ladder, highest }: Candidate) => upTo(highest, ladder.bytes);

const effortOf = ({ effort, highest }: Candidate) => upTo(highest, effort);

type Costs = Record<Unit, number>;

const isOver = (left: Costs): boolean => left.bytes < 0 || left.gpuBytes < 0 || left.count < 0;

/** A budget less what cells cost. */
function lessen({ bytes, gpuBytes, count }: Budget, rows: readonly Row[]): Costs {
  const left = { bytes, gpuBytes, count };
  for (const { c, level } of rows) {
    left.bytes -= c.ladder.bytes[level] ?? 0;
    left.gpuBytes -= c.ladder.gpuBytes[level] ?? 0;
    left.count -= c.ladder.count[level] ?? 0;
  }
  return left;
}
