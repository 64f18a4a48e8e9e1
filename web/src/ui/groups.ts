import { leastPromise } from "../core/describe";
import { ladderOf } from "../core/planner";
import type { Cell, LabelState, Trust } from "../types";

/** The labels of one category: a single label, or its instances. */
export interface Group {
  readonly key: string;
  readonly title: string;
  readonly states: readonly LabelState[];
  readonly splats: number; // in full
}

/** The content of a group's row. */
export interface Summary {
  readonly shown: number; // share of its splats in sight, or else of all
  readonly wanted: number;
  readonly promised: number; // minimum over visible labels; NaN if one of them has none
  readonly missing: boolean; // whether a visible label is not drawn
  readonly expected: number;
  readonly trust: Trust; // the least over visible labels
  readonly count: number;
  readonly bytes: number;
  readonly distance: number; // of the nearest label
  readonly visible: boolean;
  readonly loading: boolean;
  readonly error: string | null;
}

/** The labels grouped by category, with all of its instances, largest first. */
export function grouped(states: readonly LabelState[]): Group[] {
  const parents = new Set(states.map(({ label }) => label.parent));
  return groupedBy(states, ({ label }) => {
    // what has no instance of its own beside those that have: "chair" beside "chair 1"
    const isFamily = label.parent !== undefined || parents.has(label.name);
    return isFamily ? (label.parent ?? label.name) : `#${label.id}`;
  });
}

/** The labels of a category grouped by instance, largest first. */
export function instances(states: readonly LabelState[]): Group[] {
  return groupedBy(states, ({ label }) => label.name);
}

function groupedBy(states: readonly LabelState[], keyOf: (state: LabelState) => string): Group[] {
  const byCategory = new Map<string, LabelState[]>();
  for (const state of states) {
    const key = keyOf(state);
    const known = byCategory.get(key);
    if (known) known.push(state);
    else byCategory.set(key, [state]);
  }
  const groups = [...byCategory].map(([key, parts]) => ({
    key,
    title: parts.some(({ label }) => label.parent === key) ? key : (parts[0]?.label.title ?? key),
    states: parts,
    splats: parts.flatMap(({ label }) => label.cells).reduce((sum, cell) => sum + splatsOf(cell), 0),
  }));
  return groups.sort((a, b) => b.splats - a.splats);
}

const splatsOf = (cell: Cell): number => ladderOf(cell).count.at(-1) ?? 0;

const TRUST: readonly Trust[] = ["outside", "unknown", "uncalibrated", "calibrated"]; // least first

export function summary(states: readonly LabelState[]): Summary {
  const sum = (of: (state: LabelState) => number) => states.reduce((total, state) => total + of(state), 0);
  const visible = states.filter((state) => state.visible);
  const counted = visible.length ? visible : states;
  const least = (of: (state: LabelState) => number) => {
    const known = counted.map(of).filter((value) => !Number.isNaN(value));
    return known.length ? Math.min(...known) : Number.NaN;
  };
  const whole = counted.reduce((total, { splats }) => total + splats, 0);
  const part = (of: (state: LabelState) => number) =>
    counted.reduce((total, state) => total + of(state) * (state.splats / whole), 0);
  return {
    shown: part((state) => state.shown),
    wanted: part((state) => state.wanted),
    promised: leastPromise(counted),
    missing: visible.some(({ cells }) => cells.some((cell) => cell.visible && !cell.shown)),
    expected: least((state) => state.expected),
    trust: TRUST.find((trust) => counted.some((s) => s.trust === trust)) ?? "unknown",
    count: sum((state) => state.count),
    bytes: sum((state) => state.bytes),
    distance: least((state) => state.distance),
    visible: visible.length > 0,
    loading: states.some((state) => state.loading),
    error: states.find((state) => state.error)?.error ?? null,
  };
}
