/** Tracks which increments of each cell are decoded, and which of these are drawn. */

import type { Cell, Handle, Label, Level, Renderer } from "../types";
import { Points, type Sight } from "./distance";
import type { File } from "./download";
import { type Candidate, type Ladder, ladderOf } from "./planner";

/** What a byte that need not be fetched counts, in bytes to fetch: it is decoded and drawn all the same. */
const THERE = 0.25;

/** An increment with its value: pixel-weighted SSIM gain per byte, along the concave hull. */
export interface Step {
  readonly level: number; // 1-based
  readonly value: number;
}

/** A cell of the manifest. Drawn are the increments of level `shown`, or `former` until those are decoded. */
export class Entry {
  readonly ladder: Ladder;
  private readonly palettePart: number; // bytes of the label's palette that count as the cell's
  readonly replaces: boolean; // whether any level replaces those below
  readonly decoded: (Handle | undefined)[]; // by increment
  /** Of a stream, the increments that were decoded, as they came: those that are disposed of are decoded again. */
  readonly contents: (Uint8Array | undefined)[] = [];
  planned = 0;
  around = 0; // level once everything in sight is drawn as planned
  wanted = 0; // one of the two, or on the way between
  shown = 0;
  uploaded = 0; // level whose increments the GPU has: those above the drawn one stay there
  decoding = 0; // level being decoded, 0: none
  former: Drawn | null = null;
  readonly points: Points;
  sight: Sight = { visible: true, distance: Number.NaN, apparent: 0, potential: 0 };
  share = 0; // pixel share
  mean: readonly number[] = []; // by level, expected quality, never falls; NaN: unknown
  candidate: Candidate | null = null; // input of the current plan
  steps: { candidate: Candidate; have: number; first: number; found: Step[] } | null = null; // from the loaded to the planned level

  constructor(
    public label: Label,
    public cell: Cell,
  ) {
    this.palettePart = Math.ceil((label.palette?.bytes ?? 0) / label.cells.length);
    this.ladder = ladderOf(cell, this.palettePart);
    this.points = new Points(cell);
    this.replaces = cell.levels.some(({ refine }) => refine);
    this.decoded = cell.levels.map(() => undefined);
  }

  /** The increments below one that its decoder needs: those of its stream, which came in their order. */
  below(level: number): readonly Uint8Array[] {
    if (this.cell.levels[level - 1]?.format !== "stream") return [];
    return this.contents.slice(this.start(level), level - 1).flatMap((content) => content ?? []);
  }

  /** The palette that a level is decoded by: that of a label is for the highest levels, from one that replaces on. */
  paletteOf(level: number): File | undefined {
    const { palette } = this.label;
    return this.start(level) === this.start(this.cell.levels.length) ? palette : undefined;
  }

  /**
   * What each level costs to reach, in bytes: of what is there, a part, since it is drawn but not fetched again.
   *
   * @param isHere - whether a file need not be fetched
   */
  effort(isHere: (file: File) => boolean): number[] {
    let there = 0;
    return this.cell.levels.map((file, k) => {
      if (file.refine) there = 0;
      if (this.has(k + 1) || isHere(file)) there += file.bytes;
      const palette = this.paletteOf(k + 1);
      const all = there + (palette && isHere(palette) ? this.palettePart : 0);
      return (this.ladder.bytes[k] ?? 0) - (1 - THERE) * all;
    });
  }

  /** Number of increments below a level that are not part of it, since it or a level below it replaces them. */
  start(level: number): number {
    if (!this.replaces) return 0;
    for (let k = level; k > 1; k--) if (this.cell.levels[k - 1]?.refine) return k - 1;
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
    return this.cell.levels.slice(from, to).map((file, i) => ({ file, level: from + i + 1 }));
  }

  /** The drawn increments of a level. */
  drawn(level: number): Handle[] {
    return this.handles(this.start(level), level);
  }

  handles(from: number, to: number): Handle[] {
    return this.decoded.slice(from, to).filter((handle) => handle !== undefined);
  }

  /** Takes note of what is drawn now: a level that replaces others, or is below such, takes their place on the GPU. */
  show(level: number): void {
    this.shown = level;
    if (!level) return; // the GPU keeps what was drawn
    const stays = this.start(level) === this.start(this.uploaded);
    this.uploaded = stays ? Math.max(level, this.uploaded) : level;
  }

  /** Takes note that an increment that is not drawn is disposed of: if the GPU has it, only what is drawn stays there. */
  dispose(level: number): void {
    this.decoded[level - 1] = undefined;
    if (level > this.start(this.uploaded) && level <= this.uploaded) this.uploaded = this.shown;
  }

  /** Bytes on the GPU, including replaced increments that are still drawn; what else is decoded is in main memory. */
  get gpuBytes(): number {
    const own = this.ladder.gpuBytes[this.uploaded - 1] ?? 0;
    return own + (this.former ? gpuBytesOf(this.former) : 0);
  }
}

/** Drawn content that will be replaced. */
export interface Drawn {
  readonly handles: readonly Handle[];
  readonly level: number;
  readonly ladder: Ladder;
}

export const gpuBytesOf = (drawn: Drawn): number => drawn.ladder.gpuBytes[drawn.level - 1] ?? 0;

/** The drawn increments of a removed cell; disposes of its other decoded increments. */
function retire(entry: Entry, hidden: Hidden, renderer: Renderer): Drawn | null {
  const { ladder, shown } = entry;
  const handles = entry.drawn(shown);
  for (const handle of entry.handles(0, entry.decoded.length)) {
    if (handles.includes(handle)) continue;
    hidden.remove(handle);
    renderer.dispose(handle);
  }
  return shown ? { handles, level: shown, ladder } : entry.former;
}

/** Entries for the cells of all labels. */
export const entriesOf = (labels: readonly Label[]): Entry[] =>
  labels.flatMap((label) => label.cells.map((cell) => new Entry(label, cell)));

/** Entries for the cells of a new manifest, and the drawn increments of removed cells. */
export function exchange(
  entries: readonly Entry[],
  labels: readonly Label[],
  hidden: Hidden,
  renderer: Renderer,
): { entries: Entry[]; leaving: Drawn[] } {
  const before = new Map(entries.map((entry) => [entry.cell.id, entry]));
  const next = entriesOf(labels).map((fresh) => {
    const old = before.get(fresh.cell.id);
    // drawn content changes its label at once, or not at all
    if (old?.label.id !== fresh.label.id) return fresh;
    before.delete(fresh.cell.id);
    return renewed(old, fresh, hidden, renderer);
  });
  const leaving = [...before.values()].flatMap((entry) => retire(entry, hidden, renderer) ?? []);
  return { entries: next, leaving };
}

/** The entry of a cell in a new manifest: the old one if its content is the same. */
function renewed(old: Entry, fresh: Entry, hidden: Hidden, renderer: Renderer): Entry {
  const files = ({ cell }: Entry) => cell.levels.map((file) => file.key + (file.refine ?? "")).join();
  const places = ({ cell }: Entry) => [cell.bounds, cell.points, cell.area, cell.radius].join();
  if (files(old) === files(fresh) && places(old) === places(fresh)) {
    old.label = fresh.label;
    old.cell = fresh.cell;
    return old;
  }
  fresh.former = retire(old, hidden, renderer);
  return fresh;
}

/** Decoded increments that are not drawn, least recently drawn first. */
export class Hidden {
  private readonly kept = new Map<Handle, { entry: Entry; bytes: number }>();
  bytes = 0;

  constructor(private readonly renderer: Renderer) {}

  add(entry: Entry, handle: Handle): void {
    this.remove(handle);
    const bytes = entry.cell.levels[handle.level - 1]?.gpuBytes ?? 0;
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
      entry.dispose(handle.level);
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
  // new content of a live scene is swapped in completely, or neighbouring cells would not match
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
    e.show(level);
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

/** Whether a cell waits for new content that is available. */
const isChanging = (e: Entry): boolean => e.former !== null && e.wanted > 0;
