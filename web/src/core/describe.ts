/** The state of a streamer as numbers and messages, for the UI and tests. */

import type { LabelState, Screens, State } from "../types";
import { type Failure, TRIES_BEFORE_NOTICE } from "./downloads";
import type { Entry } from "./residency";

/** The data that a state is described from. */
export interface Overview {
  readonly planned: "ok" | "infeasible" | "over budget";
  readonly bytesLoaded: number;
  readonly bandwidth: number;
  readonly pending: number;
  readonly leavingBytes: number; // GPU bytes of removed labels that are still drawn
  readonly screens: Screens | null;
  readonly asked: number; // quality that the levels were chosen for; Infinity: for none
  readonly notes: readonly (string | null | undefined)[]; // most important first
  failure(entry: Entry, level: number): Failure | undefined;
}

export function describe(entries: readonly Entry[], overview: Overview): State {
  const labels = entries.map((entry) => labelState(entry, overview));
  const sum = (of: (label: LabelState) => number) => labels.reduce((total, label) => total + of(label), 0);
  const first = entries.some((e) => e.sight.visible && e.wanted > 0 && !e.shown && !e.former);
  const errors = labels.map((label) => label.error);
  return {
    labels,
    status: first ? "loading" : overview.planned,
    bytesLoaded: overview.bytesLoaded,
    bytesShown: sum((label) => label.bytes),
    gpuBytes: entries.reduce((total, e) => total + e.gpuBytes, overview.leavingBytes),
    count: sum((label) => label.count),
    bandwidth: overview.bandwidth,
    pending: overview.pending,
    screens: overview.screens,
    message: [...errors, ...overview.notes].find((note) => note) ?? null,
  };
}

function labelState(entry: Entry, overview: Overview): LabelState {
  const { label, wanted, sight, prediction } = entry;
  const { former } = entry;
  const { level, ladder } = former ?? { level: entry.shown, ladder: entry.ladder };
  return {
    label,
    wanted,
    shown: level,
    loading: entry.shown < wanted,
    error: errorOf(entry, overview),
    visible: sight.visible,
    distance: sight.distance,
    // the prediction is of the new content, and nothing is known of one that is not drawn; what was calibrated is
    // the choice for a target: more than the target is not promised
    promised: Math.min((former ? undefined : prediction.bound[level - 1]) ?? Number.NaN, overview.asked),
    expected: (former ? undefined : prediction.mean[level - 1]) ?? Number.NaN,
    trust: prediction.trust,
    count: ladder.count[level - 1] ?? 0,
    bytes: ladder.bytes[level - 1] ?? 0,
    gpuBytes: ladder.gpuBytes[level - 1] ?? 0,
  };
}

/**
 * The least quality promised of some labels as they are drawn; NaN where one is not drawn, or has a level without
 * a promise. Where nothing is known of a label, its last level stands for the full scene.
 */
export function leastPromise(labels: readonly LabelState[]): number {
  const promised = labels.map(({ promised, shown, label }) =>
    Number.isNaN(promised) && shown === label.levels.length ? Infinity : promised,
  );
  const least = Math.min(...promised);
  return least < Infinity ? least : Number.NaN;
}

function errorOf(entry: Entry, overview: Overview): string | null {
  const { title, levels } = entry.label;
  for (let level = 1; level <= levels.length; level++) {
    const failure = overview.failure(entry, level);
    if (failure?.lasting) {
      const rest = level > 1 ? `stays at level ${level - 1}` : "cannot be shown";
      return `${failure.message}; ${title} ${rest}. Make the bundle again or check the server.`;
    }
    if (failure && failure.tries >= TRIES_BEFORE_NOTICE)
      return `${failure.message}; ${title} waits, trying again.`;
  }
  return null;
}
