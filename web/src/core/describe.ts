/** The state of a streamer in words and numbers, for people and tests. */

import type { LabelState, State } from "../types";
import type { Entry } from "./residency";
import { type Failure, PATIENCE } from "./supply";

/** What the whole is described from. */
export interface Whole {
  readonly planned: "ok" | "infeasible" | "over budget";
  readonly bytesLoaded: number;
  readonly bandwidth: number;
  readonly pending: number;
  readonly leavingBytes: number; // GPU bytes of labels that go
  readonly notes: readonly (string | null | undefined)[]; // most important first
  failure(entry: Entry, level: number): Failure | undefined;
}

export function describe(entries: readonly Entry[], whole: Whole): State {
  const labels = entries.map((entry) => labelState(entry, whole));
  const sum = (of: (label: LabelState) => number) => labels.reduce((total, label) => total + of(label), 0);
  const first = entries.some((e) => e.sight.visible && e.wanted > 0 && !e.shown && !e.former);
  const errors = labels.map((label) => label.error);
  return {
    labels,
    status: first ? "loading" : whole.planned,
    bytesLoaded: whole.bytesLoaded,
    bytesShown: sum((label) => label.bytes),
    gpuBytes: entries.reduce((total, e) => total + e.gpuBytes, whole.leavingBytes),
    count: sum((label) => label.count),
    bandwidth: whole.bandwidth,
    pending: whole.pending,
    message: [...errors, ...whole.notes].find((note) => note) ?? null,
  };
}

function labelState(entry: Entry, whole: Whole): LabelState {
  const { label, wanted, sight, prediction } = entry;
  const { level, ladder } = entry.former ?? { level: entry.shown, ladder: entry.ladder };
  return {
    label,
    wanted,
    shown: level,
    loading: entry.shown < wanted,
    error: errorOf(entry, whole),
    visible: sight.visible,
    distance: sight.distance,
    promised: prediction.bound[level - 1] ?? Number.NaN,
    expected: prediction.mean[level - 1] ?? Number.NaN,
    count: ladder.count[level - 1] ?? 0,
    bytes: ladder.bytes[level - 1] ?? 0,
    gpuBytes: ladder.gpuBytes[level - 1] ?? 0,
  };
}

function errorOf(entry: Entry, whole: Whole): string | null {
  const { title, levels } = entry.label;
  for (let level = 1; level <= levels.length; level++) {
    const failure = whole.failure(entry, level);
    if (failure?.lasting) {
      const rest = level > 1 ? `stays at level ${level - 1}` : "cannot be shown";
      return `${failure.message}; ${title} ${rest}. Make the bundle again or check the server.`;
    }
    if (failure && failure.tries >= PATIENCE) return `${failure.message}; ${title} waits, trying again.`;
  }
  return null;
}
