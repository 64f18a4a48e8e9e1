/** The state of a streamer as numbers and messages, for the UI and tests. */

import type { LabelState, Screens, State } from "../types";
import { type Failure, TRIES_BEFORE_NOTICE } from "./downloads";
import type { Ladder } from "./planner";
import { boundOf } from "./quality";
import type { Entry } from "./residency";
import type { Family } from "./viewpoints";

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

export function describe(families: readonly Family[], overview: Overview): State {
  const labels = families.map((family) => labelState(family, overview));
  const entries = families.flatMap((family) => family.entries);
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

function labelState({ label, entries, outlook }: Family, overview: Overview): LabelState {
  const drawn = entries.map((e) => e.former ?? { level: e.shown, ladder: e.ladder });
  const visible = entries.filter(({ sight }) => sight.visible);
  const counted = visible.length ? visible : entries;
  const whole = counted.reduce((sum, { ladder }) => sum + (ladder.count.at(-1) ?? 0), 0);
  const part = (level: (e: Entry) => number) =>
    counted.reduce((sum, e) => sum + (e.ladder.count[level(e) - 1] ?? 0), 0) / whole;
  const total = (unit: keyof Ladder) =>
    drawn.reduce((sum, { level, ladder }) => sum + (ladder[unit][level - 1] ?? 0), 0);
  const expected = meanOf(entries);
  // what was calibrated is the choice for a target: more than the target is not promised
  const promised = outlook.keeps ? Math.min(boundOf(outlook.keeps, expected), overview.asked) : Number.NaN;
  return {
    label,
    cells: entries.map(({ cell, wanted, sight }, i) => {
      return { cell, wanted, shown: drawn[i]?.level ?? 0, visible: sight.visible };
    }),
    splats: whole,
    wanted: part(({ wanted }) => wanted),
    shown: part(({ shown }) => shown),
    loading: entries.some(({ shown, wanted }) => shown < wanted),
    error: entries.reduce<string | null>((error, e) => error ?? errorOf(e, overview), null),
    visible: visible.length > 0,
    distance: visible.length ? Math.min(...visible.map(({ sight }) => sight.distance)) : Number.NaN,
    promised,
    expected,
    trust: outlook.trust,
    count: total("count"),
    bytes: total("bytes"),
    gpuBytes: total("gpuBytes"),
  };
}

/**
 * Mean quality of what is drawn of a label, over its pixels, or where none are in sight over its cells; NaN where
 * a part is unknown, not drawn, or of an earlier manifest.
 */
function meanOf(entries: readonly Entry[]): number {
  const seen = entries.filter(({ share }) => share > 0);
  const counted = seen.length ? seen : entries;
  let [sum, total] = [0, 0];
  for (const { share, mean, shown, former } of counted) {
    const weight = seen.length ? share : 1;
    sum += weight * (former ? Number.NaN : (mean[shown - 1] ?? Number.NaN));
    total += weight;
  }
  return sum / total;
}

/**
 * The least quality promised of some labels as they are drawn; NaN where one is not drawn, or is drawn at levels
 * without a promise. Where nothing is known of a label, its last levels stand for the full scene.
 */
export function leastPromise(labels: readonly LabelState[]): number {
  const least = Math.min(
    ...labels.map(({ promised, shown }) => (Number.isNaN(promised) && shown === 1 ? Infinity : promised)),
  );
  return least < Infinity ? least : Number.NaN;
}

function errorOf(entry: Entry, overview: Overview): string | null {
  const { title: name, cells } = entry.label;
  const title = cells.length > 1 ? `a part of ${name}` : name;
  const { levels } = entry.cell;
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
