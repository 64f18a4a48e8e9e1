import { leastPromise } from "../core/describe";
import { ladderOf } from "../core/planner";
import type { LabelState, Trust } from "../types";

/** The labels of one category: a single label, its instances, or its per-block categories in a scene in blocks. */
export interface Group {
  readonly key: string;
  readonly title: string;
  readonly states: readonly LabelState[]; // sorted by block
  readonly splats: number; // of the last level
}

/** The content of a group's row. */
export interface Summary {
  readonly shown: number; // share of its levels
  readonly wanted: number;
  readonly level: string; // "2/6", or "1–4/6" if the blocks differ
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

/** The labels grouped by category, with all of its instances and blocks, largest first. */
export function grouped(states: readonly LabelState[]): Group[] {
  const parents = new Set(states.map(({ label }) => label.parent));
  return groupedBy(states, ({ label }) => {
    const name = label.category ?? label.name;
    // what has no instance of its own beside those that have: "chair" beside "chair 1"
    if (label.parent !== undefined || parents.has(name)) return label.parent ?? name;
    return label.block === undefined ? `#${label.id}` : name;
  });
}

/** The labels of a category grouped by instance, largest first. */
export function instances(states: readonly LabelState[]): Group[] {
  return groupedBy(states, ({ label }) => label.category ?? label.name);
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
    states: parts.sort((a, b) => (a.label.block ?? 0) - (b.label.block ?? 0)),
    splats: parts.reduce((sum, { label }) => sum + (ladderOf(label).count.at(-1) ?? 0), 0),
  }));
  return groups.sort((a, b) => b.splats - a.splats);
}

const TRUST: readonly Trust[] = ["outside", "unknown", "uncalibrated", "calibrated"]; // least first

export function summary(states: readonly LabelState[]): Summary {
  const sum = (of: (state: LabelState) => number) => states.reduce((total, state) => total + of(state), 0);
  const levels = sum(({ label }) => label.levels.length);
  const visible = states.filter((state) => state.visible);
  const counted = visible.length ? visible : states;
  const least = (of: (state: LabelState) => number) => {
    const known = counted.map(of).filter((value) => !Number.isNaN(value));
    return known.length ? Math.min(...known) : Number.NaN;
  };
  const shown = counted.map((state) => state.shown);
  const [low, high] = [Math.min(...shown), Math.max(...shown)];
  const last = Math.max(...states.map(({ label }) => label.levels.length));
  return {
    shown: sum((state) => state.shown) / levels,
    wanted: sum((state) => state.wanted) / levels,
    level: `${low === high ? low : `${low}–${high}`}/${last}`,
    promised: leastPromise(counted),
    missing: visible.some((state) => !state.shown),
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

/** A colour for a block, with hues spread by the golden angle. */
export const blockColor = (block: number): string => {
  const hue = (block * 137.508) % 360;
  const channel = (at: number) => {
    const k = (at + hue / 30) % 12;
    const value = 0.55 - 0.3 * Math.max(-1, Math.min(k - 3, 9 - k, 1));
    return Math.round(255 * value)
      .toString(16)
      .padStart(2, "0");
  };
  return `#${channel(0)}${channel(8)}${channel(4)}`;
};
