/** Plans the level of each cell from settings and a viewpoint. Levels are 1-based, 0 is nothing. */

import type { Budget, Level, Settings } from "../types";
import { cheapest, known, together } from "./allocate";
import { fill } from "./fill";
import { hull, type Segment, steepest } from "./hull";

/** The planner's input for a cell, or for a label all of whose cells have one level. */
export interface Candidate {
  readonly ladder: Ladder;
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
const LEAST_SHARE = 1e-4; // least pixel share, so that every visible cell counts
const SLACK = 0.01; // least gain of quality for which a budget's levels are left

/** Costs of levels as sums over their increments, from the newest that replaces those below. */
export function ladderOf({ levels }: { readonly levels: readonly Level[] }): Ladder {
  const sums = (unit: Unit) => {
    let sum = 0;
    return levels.map((level) => {
      sum = level[unit] + (level.refine ? 0 : sum);
      return sum;
    });
  };
  return { bytes: sums("bytes"), gpuBytes: sums("gpuBytes"), count: sums("count") };
}

/** Weight of a cell at this viewpoint. */
export const visibleWeight = (c: Candidate): number =>
  c.visible ? c.weight * Math.max(c.share, LEAST_SHARE) : 0;

/** The same, as if the cell were in sight. */
export const potentialWeight = (c: Candidate): number => c.weight * Math.max(c.potential, LEAST_SHARE);

/** Levels, from 0. */
type Levels = Map<Candidate, number>;

/** The planned levels, within the budget in all units; the smallest composition if nothing fits. */
export function makePlan(groups: readonly Group[], settings: Settings): Plan {
  const there = withoutUnseen(
    groups.flatMap(({ cells }) => cells.filter((c) => c.highest > 0)),
    settings.budget,
  );
  const fixed = there.filter((c) => c.always);
  const free = there.filter((c) => !c.always);
  const left = lessen(settings.budget, fixed, (c) => c.highest - 1);
  const levels: Levels = new Map(free.map((c) => [c, 0]));
  const status = choose(groups, levels, settings, left);
  const around = raised(levels, settings, left);
  for (const c of fixed) for (const all of [levels, around]) all.set(c, c.highest - 1);
  const listed = (all: Levels) => groups.map(({ cells }) => cells.map((c) => (all.get(c) ?? -1) + 1));
  return { wanted: listed(levels), around: listed(around), status };
}

/** Leaves out cells out of sight where not even the lowest levels fit, those of least apparent size first. */
function withoutUnseen(all: readonly Candidate[], budget: Budget): readonly Candidate[] {
  const over = { ...lessen(budget, all, (c) => (c.always ? c.highest - 1 : 0)) };
  const lacks = () => UNITS.some((unit) => over[unit] < 0);
  if (!lacks()) return all;
  const out = new Set<Candidate>();
  const unseen = all.filter((c) => !c.visible && !c.always);
  for (const c of unseen.sort((a, b) => potentialWeight(a) - potentialWeight(b))) {
    if (!lacks()) break;
    out.add(c);
    for (const unit of UNITS) over[unit] += c.ladder[unit][0] ?? 0;
  }
  return all.filter((c) => !out.has(c));
}

/** Raises the levels, which are the lowest, by the settings. */
function choose(
  groups: readonly Group[],
  levels: Levels,
  settings: Settings,
  budget: Budget,
): Plan["status"] {
  const { mode } = settings;
  if (mode === "budget") return within(levels, budget);
  const asked = mode === "target" ? reach(groups, levels, settings) : "ok";
  if (mode === "full") for (const c of levels.keys()) levels.set(c, c.highest - 1);
  if (fits(levels, budget)) return asked;
  for (const c of levels.keys()) levels.set(c, 0);
  const status = within(levels, budget);
  return status === "ok" ? "infeasible" : status;
}

/**
 * The cheapest levels that reach a target; the first level out of sight. For a target of fidelity the picture
 * as a whole is not to be worse than equal levels of all cells would be for the same bytes.
 */
function reach(groups: readonly Group[], levels: Levels, { quality, target }: Settings): Plan["status"] {
  let status: Plan["status"] = "ok";
  const seen: Candidate[] = [];
  for (const { cells, needed, bound } of groups) {
    const mine = cells.filter((c) => levels.has(c) && c.visible && c.weight > 0);
    if (!mine.length) continue;
    seen.push(...mine);
    const cost = mine.map((c) => costOf(c, "bytes"));
    const previous = mine.map(before);
    const isKnown = bound || (!Number.isNaN(needed) && mine.every(({ mean }) => !mean.every(Number.isNaN)));
    const found = bound
      ? cheapest([bound.slice(0, mine[0]?.highest)], cost, target, { previous })
      : together(
          { cost, mean: mine.map(qualityOf), share: mine.map(({ share }) => share), previous },
          isKnown ? needed : 1,
        );
    if (found.status !== "ok") status = "infeasible";
    mine.forEach((c, i) => {
      levels.set(c, found.levels[i] ?? 0);
    });
  }
  if (quality !== "fidelity") return status;
  const filled = fill(
    seen.map((c) => levels.get(c) ?? 0),
    seen.map((c) => c.mean),
    seen.map((c) => costOf(c, "bytes")),
    seen.map(visibleWeight),
  );
  seen.forEach((c, i) => {
    levels.set(c, filled[i] ?? 0);
  });
  return status;
}

/**
 * Upgrades by falling gain per cost, each taken if it still fits in every unit. The cost is the largest part of
 * the budgets.
 */
function within(levels: Levels, budget: Budget): Plan["status"] {
  if (!fits(levels, budget)) return "over budget";
  const cells = [...levels.keys()];
  const values = cells.map((c) => qualityOf(c).map((quality) => visibleWeight(c) * quality));
  const part = (c: Candidate, k: number) =>
    Math.max(...UNITS.map((unit) => (c.ladder[unit][k] as number) / budget[unit] || 0));
  const segments = cells.flatMap((c, i) => {
    const value = values[i] ?? [];
    return value.at(-1) === 0
      ? []
      : hull(
          value.map((_, k) => part(c, k)),
          value,
          0,
          i,
        );
  });
  takeFitting(
    cells,
    levels,
    steepest(segments),
    lessen(budget, cells, () => 0),
  );
  const value = (of: (c: Candidate) => number) =>
    cells.reduce((sum, c, i) => sum + (values[i]?.[of(c)] ?? 0), 0);
  // levels in sight that are about as good stay
  const earlier: Levels = new Map(cells.map((c) => [c, c.visible && c.weight > 0 ? before(c) : 0]));
  const weight = cells.reduce((sum, c) => sum + visibleWeight(c), 0);
  const stays =
    cells.every((c) => (earlier.get(c) ?? -1) >= 0) &&
    fits(earlier, budget) &&
    value((c) => earlier.get(c) ?? 0) >= value((c) => levels.get(c) ?? 0) - SLACK * weight;
  if (stays) for (const [c, level] of earlier) levels.set(c, level);
  return "ok";
}

/** Takes each segment that continues its cell's level and fits into what is left, which it lessens. */
function takeFitting(
  cells: readonly Candidate[],
  levels: Levels,
  segments: readonly Segment[],
  left: Record<Unit, number>,
): void {
  for (const { row, from, to } of segments) {
    const c = cells[row] as Candidate;
    if (levels.get(c) !== from) continue;
    const more = (unit: Unit) => (c.ladder[unit][to] as number) - (c.ladder[unit][from] as number);
    if (!UNITS.every((unit) => more(unit) <= left[unit])) continue;
    for (const unit of UNITS) left[unit] -= more(unit);
    levels.set(c, to);
  }
}

/** The levels with cells out of sight raised, the largest first, by a segment at a time. */
function raised(levels: Levels, { mode, aroundBytes }: Settings, budget: Budget): Levels {
  const around: Levels = new Map(levels);
  const left = lessen(budget, [...levels.keys()], (c) => levels.get(c) ?? 0);
  if (mode === "full" || mode === "base" || UNITS.some((unit) => left[unit] < 0)) return around;
  const cells = [...levels.keys()]
    .filter((c) => !c.visible && c.weight > 0)
    .sort((a, b) => b.potential - a.potential);
  const steps = cells.map((c, i) => hull(costOf(c, "bytes"), qualityOf(c), levels.get(c), i));
  const rounds = Math.max(0, ...steps.map(({ length }) => length));
  const inTurn = Array.from({ length: rounds }, (_, round) => steps.flatMap((own) => own[round] ?? []));
  takeFitting(cells, around, inTurn.flat(), { ...left, bytes: Math.min(left.bytes, aroundBytes) });
  return around;
}

/** Expected quality by available level: an unknown one as the one below, by the bytes if all are. */
function qualityOf({ mean, ladder, highest }: Candidate): number[] {
  const cost = ladder.bytes.slice(0, highest);
  const { q, promised } = known([mean.slice(0, highest)], [cost]);
  let last = 0;
  return (q[0] ?? []).map((quality, k) => {
    if (!promised[0] || !Number.isNaN(mean[k])) last = quality;
    return last;
  });
}

const before = (c: Candidate): number => (c.previous <= c.highest ? c.previous - 1 : -1);

/** Cost by available level. */
const costOf = (c: Candidate, unit: Unit): readonly number[] => c.ladder[unit].slice(0, c.highest);

const fits = (levels: Levels, budget: Budget): boolean => {
  const left = lessen(budget, [...levels.keys()], (c) => levels.get(c) ?? 0);
  return UNITS.every((unit) => left[unit] >= 0);
};

/** A budget less what cells cost at a level, from 0. */
function lessen(
  budget: Budget,
  cells: readonly Candidate[],
  level: (c: Candidate) => number,
): Record<Unit, number> {
  const left = { ...budget };
  for (const c of cells) for (const unit of UNITS) left[unit] -= c.ladder[unit][level(c)] ?? 0;
  return left;
}
