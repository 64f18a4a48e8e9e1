/** Tracks which increments of each label are decoded, and which of these are drawn. */

import type { Handle, Label, Level, Renderer } from "../types";
import type { Sight } from "./distance";
import type { Step } from "./order";
import { type Candidate, type Ladder, ladderOf } from "./planner";
import type { Prediction } from "./quality";

/** A label of the manifest. Drawn are increments 1..shown, or `former` until those are decoded. */
export class Entry {
  readonly ladder: Ladder;
  readonly decoded: (Handle | null | undefined)[]; // by increment; null: an empty one
  wanted = 0;
  shown = 0;
  decoding = 0; // level being decoded, 0: none
  former: Drawn | null = null;
  sight: Sight = { visible: true, distance: Number.NaN, size: 0 };
  share = 0; // pixel share
  candidate: Candidate | null = null; // input of the current plan
  steps: { candidate: Candidate; have: number; found: Step[] } | null = null; // from the loaded to the planned level
  prediction: Prediction = { mean: [], bound: [], support: Number.NaN, trust: "unknown" };

  constructor(public label: Label) {
    this.ladder = ladderOf(label);
    this.decoded = label.levels.map((file) => (file.count ? undefined : null));
  }

  /** Level up to which all increments are decoded. */
  get ready(): number {
    const missing = this.decoded.indexOf(undefined);
    return missing < 0 ? this.decoded.length : missing;
  }

  /** The files of the increments, with their levels. */
  files(from: number, to: number): { file: Level; level: number }[] {
    return this.label.levels.slice(from, to).map((file, i) => ({ file, level: from + i + 1 }));
  }

  handles(from: number, to: number): Handle[] {
    return this.decoded.slice(from, to).filter((handle) => handle !== undefined && handle !== null);
  }

  /** GPU bytes of all decoded increments, including replaced ones that are still drawn. */
  get gpuBytes(): number {
    const own = this.label.levels.reduce((sum, file, i) => sum + (this.decoded[i] ? file.gpuBytes : 0), 0);
    return own + (this.former ? gpuBytesOf(this.former) : 0);
  }
}

/** Drawn content that will be replaced. */
export interface Drawn {
  readonly label: Label;
  readonly handles: readonly Handle[];
  readonly level: number;
  readonly ladder: Ladder;
}

export const gpuBytesOf = (drawn: Drawn): number => drawn.ladder.gpuBytes[drawn.level - 1] ?? 0;

/** The drawn increments of a removed label; disposes of its other decoded increments. */
function retire(entry: Entry, hidden: Hidden, renderer: Renderer): Drawn | null {
  for (const handle of entry.handles(entry.shown, entry.decoded.length)) {
    hidden.remove(handle);
    renderer.dispose(handle);
  }
  const { label, ladder, shown } = entry;
  return shown ? { label, handles: entry.handles(0, shown), level: shown, ladder } : entry.former;
}

/** Entries for the labels of a new manifest, and the drawn increments of removed labels. */
export function exchange(
  entries: readonly Entry[],
  labels: readonly Label[],
  hidden: Hidden,
  renderer: Renderer,
): { entries: Entry[]; leaving: Drawn[] } {
  const before = new Map(entries.map((entry) => [entry.label.id, entry]));
  const next = labels.map((label) => {
    const old = before.get(label.id);
    before.delete(label.id);
    return old ? renewed(old, label, hidden, renderer) : new Entry(label);
  });
  const leaving = [...before.values()].flatMap((entry) => retire(entry, hidden, renderer) ?? []);
  return { entries: next, leaving };
}

/** The entry of a label in a new manifest: the old one if its content is the same. */
function renewed(old: Entry, label: Label, hidden: Hidden, renderer: Renderer): Entry {
  const files = (of: Label) => of.levels.map((file) => file.sha256).join();
  if (files(old.label) === files(label)) {
    old.label = label;
    return old;
  }
  const entry = new Entry(label);
  entry.former = retire(old, hidden, renderer);
  return entry;
}

/** Decoded increments that are not drawn, least recently drawn first. */
export class Hidden {
  private readonly kept = new Map<Handle, { entry: Entry; bytes: number }>();
  bytes = 0;

  constructor(private readonly renderer: Renderer) {}

  add(entry: Entry, handle: Handle): void {
    this.remove(handle);
    const bytes = entry.label.levels[handle.level - 1]?.gpuBytes ?? 0;
    this.kept.set(handle, { entry, bytes });
    this.bytes += bytes;
  }

  remove(handle: Handle): void {
    this.bytes -= this.kept.get(handle)?.bytes ?? 0;
    this.kept.delete(handle);
  }

  /** Disposes of the least recently drawn increments until the rest is within a limit of GPU bytes. */
  shrink(limit: number): void {
    for (const [handle, { entry }] of this.kept) {
      if (this.bytes <= limit) return;
      this.remove(handle);
      entry.decoded[handle.level - 1] = undefined;
      this.renderer.dispose(handle);
    }
  }
}

/** Draws the wanted levels as far as they are decoded, in one tick. */
export function settle(
  entries: readonly Entry[],
  leaving: Drawn[],
  hidden: Hidden,
  renderer: Renderer,
): void {
  const show: Handle[] = [];
  const hide: Handle[] = [];
  const gone: Handle[] = [];
  // new content of a live scene is swapped in completely, or neighbouring labels would not match
  const renewed = entries.every((e) => !isChanging(e) || e.ready >= e.wanted);
  for (const e of entries) {
    if (isChanging(e) ? !renewed : e.former) continue;
    const level = Math.min(e.wanted, e.ready);
    for (const handle of e.handles(e.shown, level)) {
      hidden.remove(handle);
      show.push(handle);
    }
    hide.push(...e.handles(level, e.shown));
    // the top level first, so that it is disposed of first
    for (const handle of e.handles(level, e.former ? e.decoded.length : e.shown).reverse())
      hidden.add(e, handle);
    e.shown = level;
    gone.push(...(e.former?.handles ?? []));
    e.former = null;
  }
  if (renewed) for (const drawn of leaving.splice(0)) gone.push(...drawn.handles);
  if (!show.length && !hide.length && !gone.length) return;
  renderer.swap(show, [...hide, ...gone]);
  for (const handle of gone) renderer.dispose(handle);
}

/** Whether a label waits for new content that is available. */
const isChanging = (e: Entry): boolean => e.former !== null && e.wanted > 0;
