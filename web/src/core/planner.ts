/** Plans the level of each label from settings and a viewpoint. Levels are 1-based, 0 is nothing. */

import type { Budget, Label, Settings } from "../types";
import { type Allocation, bestWithin, cheapest } from "./allocate";
import { fill } from "./fill";

/** The planner's input for one label. */
export interface Candidate {
  readonly label: Label;
  readonly always?: boolean; // instead of the label\'s
  readonly ladder: Ladder;
  readonly highest: number; // highest available level; lower if an increment is damaged
  readonly mean: readonly number[]; // by level, quality; NaN: unknown
  readonly bound: readonly number[];
  readonly weight: number; // of the label, set by the user
  readonly share: number; // pixel share; out of sight the one that it would have
  readonly visible: boolean;
  readonly previous: number; // level in the previous plan, 0: none
}

/** Total costs of a label's levels. */
export interface Ladder {
  readonly bytes: readonly number[];
  readonly gpuBytes: readonly number[];
  readonly count: readonly number[];
}

export interface Plan {
  readonly wanted: readonly number[]; // level per candidate
  readonly status: "ok" | "infeasible" | "over budget";
}

const UNITS = ["bytes", "gpuBytes", "count"] as const;
type Unit = (typeof UNITS)[number];
const BUDGET_STEPS = 2 ** 20; // steps of a budget when several units are combined
const LEAST_SHARE = 1e-4; // least pixel share, so that every visible label counts

/** Costs of levels as sums over their increments, from the newest that replaces those below. */
export function ladderOf(label: Label): Ladder {
  const sums = (unit: Unit) => {
    let sum = 0;
    return label.levels.map((level) => {
      sum = level[unit] + (level.refine ? 0 : sum);
      return sum;
    });
  };
  return { bytes: sums("bytes"), gpuBytes: sums("gpuBytes"), count: sums("count") };
}

/** Weight of a label at this viewpoint. */
export const visibleWeight = (c: Candidate): number => (c.visible ? potentialWeight(c) : 0);

/** The same, as if the label were in sight. */
export const potentialWeight = (c: Candidate): number => c.weight * Math.max(c.share, LEAST_SHARE);

const isAlways = (c: Candidate): boolean => c.always ?? c.label.always;

/** The planned levels, within the budget in all units; the smallest composition if nothing fits. */
export function makePlan(candidates: readonly Candidate[], settings: Settings): Plan {
  const there = withoutFar(
    candidates.filter((c) => c.highest > 0),
    settings.budget,
  );
  const fixed = there.filter((c) => isAlways(c));
  const free = there.filter((c) => !isAlways(c));
  const left = lessen(settings.budget, fixed);
  const found = free.length ? choose(free, settings, left) : { levels: [], status: statusOf(left) };
  const levels = new Map(free.map((c, i) => [c, (found.levels[i] ?? 0) + 1]));
  for (const c of fixed) levels.set(c, c.highest);
  return { wanted: candidates.map((c) => levels.get(c) ?? 0), status: found.status };
}

/**
 * Removes per-block categories out of sight that do not fit even at their first level, least weight first.
 * Labels in sight stay, as do all labels of a scene without blocks.
 */
function withoutFar(all: readonly Candidate[], budget: Budget): readonly Candidate[] {
  const least = (c: Candidate) => (isAlways(c) ? c.highest : 1) - 1;
  const over = { ...budget };
  for (const unit of UNITS) for (const c of all) over[unit] -= c.ladder[unit][least(c)] ?? 0;
  const lacks = () => UNITS.some((unit) => over[unit] < 0);
  if (!lacks()) return all;
  const far = all.filter((c) => c.label.block !== undefined && !c.visible && !isAlways(c));
  const out = new Set<Candidate>();
  for (const c of far.sort((a, b) => potentialWeight(a) - potentialWeight(b))) {
    if (!lacks()) break;
    out.add(c);
    for (const unit of UNITS) over[unit] += c.ladder[unit][0] ?? 0;
  }
  return all.filter((c) => !out.has(c));
}

interface Chosen {
  readonly levels: readonly number[]; // from 0
  readonly status: Plan["status"];
}

function choose(free: readonly Candidate[], settings: Settings, budget: Budget): Chosen {
  if (settings.mode === "budget") return within(free, budget);
  const asked = settings.mode === "target" ? reach(free, settings) : same(free, settings.mode);
  if (fits(free, asked.levels, budget)) return asked;
  const { levels, status } = within(free, budget);
  return { levels, status: status === "ok" ? "infeasible" : status };
}

function same(free: readonly Candidate[], mode: "full" | "base"): Chosen {
  return { levels: free.map((c) => (mode === "full" ? c.highest - 1 : 0)), status: "ok" };
}

/**
 * The cheapest levels that reach a target; the first level out of sight. For a target of fidelity the picture
 * as a whole is not to be worse than equal levels of all categories would be for the same bytes.
 */
function reach(free: readonly Candidate[], { quality, target }: Settings): Chosen {
  const levels = free.map(() => 0);
  const seen = free.flatMap((c, i) => (c.visible && c.weight > 0 ? [{ c, i }] : []));
  if (!seen.length) return { levels, status: "ok" };
  const bounds = seen.map(({ c }) => c.bound);
  const costs = seen.map(({ c }) => costOf(c, "bytes"));
  const found = cheapest(bounds, costs, target, { previous: seen.map(({ c }) => before(c)) });
  const weights = seen.map(({ c }) => visibleWeight(c));
  const filled =
    quality === "fidelity"
      ? fill(
          found.levels,
          seen.map(({ c }) => c.mean),
          costs,
          weights,
        )
      : found.levels;
  seen.forEach(({ i }, row) => {
    levels[i] = filled[row] ?? 0;
  });
  return { levels, status: found.status };
}

/** The levels with the largest expected quality within the budget in every unit. */
function within(free: readonly Candidate[], budget: Budget): Chosen {
  const [tightest, ...others] = [...UNITS].sort((a, b) => room(free, budget, a) - room(free, budget, b));
  const first = best(free, (c) => costOf(c, tightest as Unit), budget[tightest as Unit]);
  if (first.status === "over budget" || others.every((unit) => fitsIn(free, first.levels, budget, unit))) {
    return first;
  }
  // the largest share over all budgets, as the cost, respects each of them
  const largest = (c: Candidate, k: number) =>
    Math.max(...UNITS.map((unit) => (costOf(c, unit)[k] as number) / budget[unit] || 0));
  const joint = best(
    free,
    (c) => c.label.levels.map((_, k) => Math.ceil(BUDGET_STEPS * largest(c, k))),
    BUDGET_STEPS,
  );
  return { levels: joint.levels, status: fits(free, joint.levels, budget) ? "ok" : "over budget" };
}

function best(
  free: readonly Candidate[],
  cost: (c: Candidate) => readonly number[],
  budget: number,
): Allocation {
  return bestWithin(
    free.map((c) => c.mean),
    free.map(cost),
    free.map(visibleWeight),
    Math.max(budget, 0),
    { previous: free.map(before) },
  );
}

const before = (c: Candidate): number => (c.previous <= c.highest ? c.previous - 1 : -1);

/** Cost by level; Infinity for unavailable levels. */
const costOf = (c: Candidate, unit: Unit): readonly number[] =>
  c.ladder[unit].map((cost, k) => (k < c.highest ? cost : Infinity));

/** Budget as a share of the full model's cost. */
function room(free: readonly Candidate[], budget: Budget, unit: Unit): number {
  const full = free.reduce((sum, c) => sum + (c.ladder[unit][c.highest - 1] ?? 0), 0);
  return full > 0 ? budget[unit] / full : Infinity;
}

const fits = (free: readonly Candidate[], levels: readonly number[], budget: Budget): boolean =>
  UNITS.every((unit) => fitsIn(free, levels, budget, unit));

function fitsIn(free: readonly Candidate[], levels: readonly number[], budget: Budget, unit: Unit): boolean {
  const cost = free.reduce((sum, c, i) => sum + (c.ladder[unit][levels[i] ?? 0] ?? 0), 0);
  return cost <= budget[unit];
}

function lessen(budget: Budget, fixed: readonly Candidate[]): Budget {
  const cost = (unit: Unit) => fixed.reduce((sum, c) => sum + (c.ladder[unit][c.highest - 1] ?? 0), 0);
  return {
    bytes: budget.bytes - cost("bytes"),
    gpuBytes: budget.gpuBytes - cost("gpuBytes"),
    count: budget.count - cost("count"),
  };
}

const statusOf = (left: Budget): Plan["status"] =>
  UNITS.every((unit) => left[unit] >= 0) ? "ok" : "over budget";
