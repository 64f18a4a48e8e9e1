/** Tracks which increments of each label are decoded, and which of these are drawn. */

import type { Handle, Label, Level, Renderer } from "../types";
import type { Sight } from "./distance";
import { type Candidate, type Ladder, ladderOf } from "./planner";
import type { Prediction } from "./quality";

/** An increment with its value: pixel-weighted SSIM gain per byte, along the concave hull. */
export interface Step {
  readonly level: number; // 1-based
  readonly value: number;
}

/** A label of the manifest. Drawn are the increments of level `shown`, or `former` until those are decoded. */
export class Entry {
  readonly ladder: Ladder;
  readonly replaces: boolean; // whether any level replaces those below
  readonly decoded: (Handle | undefined)[]; // by increment
  /** Of a stream, the increments that were decoded, as they came: those that are disposed of are decoded again. */
  readonly contents: (Uint8Array | undefined)[] = [];
  wanted = 0;
  shown = 0;
  decoding = 0; // level being decoded, 0: none
  former: Drawn | null = null;
  sight: Sight = { visible: true, distance: Number.NaN, size: 0 };
  share = 0; // pixel share
  candidate: Candidate | null = null; // input of the current plan
  steps: { candidate: Candidate; have: number; first: number; found: Step[] } | null = null; // from the loaded to the planned level
  prediction: Prediction = { mean: [], bound: [], support: Number.NaN, trust: "unknown" };

  constructor(public label: Label) {
    this.ladder = ladderOf(label);
    this.replaces = label.levels.some(({ refine }) => refine);
    this.decoded = label.levels.map(() => undefined);
  }

  /** Number of increments below a level that are not part of it, since it or a level below it replaces them. */
  start(level: number): number {
    if (!this.replaces) return 0;
    for (let k = level; k > 1; k--) if (this.label.levels[k - 1]?.refine) return k - 1;
    return 0;
  }

  /** Whether nothing needs to be downloaded for an increment. */
  has(level: number): boolean {
    return this.decoded[level - 1] !== undefined || this.contents[level - 1] !== undefined;
  }

  /** Whether all increments of a level are decoded. */
  isComplete(level: number): boolean {
    const missing = this.decoded.indexOf(undefined, this.start(level));
    return missing < 0 || missing >= level;
  }

  /** The highest complete level up to another, 0: none. */
  complete(most: number): number {
    if (!this.replaces) {
      const missing = this.decoded.indexOf(undefined);
      return missing < 0 ? most : Math.min(most, missing);
    }
    let level = most;
    while (level > 0 && !this.isComplete(level)) level -= 1;
    return level;
  }

  /** The level to draw now: on the way down over one that replaces, the drawn one until the lower one is complete. */
  get drawable(): number {
    const level = this.complete(this.wanted);
    return level < this.wanted && this.shown > this.wanted ? this.shown : level;
  }

  /**
   * The increments that the planned level takes, in their order. While nothing can be drawn, the first level
   * comes before one that replaces it; those between would be thrown away.
   */
  get path(): { file: Level; level: number }[] {
    const { wanted } = this;
    const start = this.start(wanted);
    const files = this.files(start, wanted);
    return start && !this.shown && !this.complete(wanted) ? [...this.files(0, 1), ...files] : files;
  }

  /** The level of the first increment of the path that is not decoded, 0: none. */
  get next(): number {
    if (this.replaces)
      return this.path.find(({ level }) => this.decoded[level - 1] === undefined)?.level ?? 0;
    const missing = this.decoded.indexOf(undefined);
    return missing < this.wanted ? missing + 1 : 0;
  }

  files(from: number, to: number): { file: Level; level: number }[] {
    return this.label.levels.slice(from, to).map((file, i) => ({ file, level: from + i + 1 }));
  }

  /** The drawn increments of a level. */
  drawn(level: number): Handle[] {
    return this.handles(this.start(level), level);
  }

  handles(from: number, to: number): Handle[] {
    return this.decoded.slice(from, to).filter((handle) => handle !== undefined);
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
  const { label, ladder, shown } = entry;
  const handles = entry.drawn(shown);
  for (const handle of entry.handles(0, entry.decoded.length)) {
    if (handles.includes(handle)) continue;
    hidden.remove(handle);
    renderer.dispose(handle);
  }
  return shown ? { label, handles, level: shown, ladder } : entry.former;
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
  const files = (of: Label) => of.levels.map((file) => file.sha256 + (file.refine ?? "")).join();
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

  has(handle: Handle): boolean {
    return this.kept.has(handle);
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
  const renewed = entries.every((e) => !isChanging(e) || e.isComplete(e.wanted));
  for (const e of entries) {
    if (isChanging(e) ? !renewed : e.former) continue;
    const level = e.drawable;
    const continues = e.start(level) === e.start(e.shown);
    for (const handle of continues ? e.handles(e.shown, level) : e.drawn(level)) {
      hidden.remove(handle);
      show.push(handle);
    }
    const former = continues ? e.handles(level, e.shown) : e.drawn(e.shown);
    hide.push(...former);
    // the top level first, so that it is disposed of first
    for (const handle of former.reverse()) hidden.add(e, handle);
    e.shown = level;
    if (e.former || e.replaces) keepOthers(e, hidden);
    gone.push(...(e.former?.handles ?? []));
    e.former = null;
  }
  if (renewed) for (const drawn of leaving.splice(0)) gone.push(...drawn.handles);
  if (!show.length && !hide.length && !gone.length) return;
  renderer.swap(show, [...hide, ...gone]);
  for (const handle of gone) renderer.dispose(handle);
}

/** Decoded increments that are neither drawn nor on the way to it count as hidden, the top ones first. */
function keepOthers(e: Entry, hidden: Hidden): void {
  const used = new Set([...e.drawn(e.shown), ...e.path.map(({ level }) => e.decoded[level - 1])]);
  for (const handle of e.handles(0, e.decoded.length).reverse()) {
    if (used.has(handle)) hidden.remove(handle);
    else if (!hidden.has(handle)) hidden.add(e, handle);
  }
}

/** Whether a label waits for new content that is available. */
const isChanging = (e: Entry): boolean => e.former !== null && e.wanted > 0;
