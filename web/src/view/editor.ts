/** Selects what is pointed at, and edits labels. What it does to the view is undone when it is closed. */

import { type Category, Edits, type Operation, type Origin, type Ranks, runsOf } from "../core/edits";
import { grow } from "../core/grow";
import { type Packed, type Picked, pick } from "../core/pick";
import type { Streamer } from "../core/streamer";
import type { Cell, Label, Manifest, Settings } from "../types";
import { ENCODING } from "./packing";
import { Mark } from "./spark";
import type { Stage } from "./stage";

/** What is selected around a point: an instance, the whole category, or what is connected and of like colour. */
export const SCOPES = ["instance", "category", "alike"] as const;
export type Scope = (typeof SCOPES)[number];

const TOLERANCES = [0.1, 0.16, 0.22, 0.3, 0.4, 0.55]; // in colour, of what is alike
const DEFAULT_TOLERANCE = 3;
const SAME_PLACE = 6; // px between clicks that are taken for one place

export interface Selection {
  readonly scope: Scope;
  readonly category: number; // number in `Edits.categories`
  readonly masks: ReadonlyMap<number, Uint8Array>; // splats by label id and rank
  readonly count: number;
}

interface Seed extends Picked {
  readonly x: number;
  readonly y: number;
}

/** What the editor needs of the viewer. */
export interface EditableView {
  readonly manifest: Manifest;
  readonly stage: Stage;
  readonly streamer: Streamer;
  readonly settings: Settings;
  set(partial: Partial<Settings>): void;
  isHidden(label: number): boolean;
  setHidden(labels: readonly number[], hidden: boolean): void;
}

export class Editor {
  readonly edits: Edits;
  selection: Selection | null = null;
  isOpen = false;
  isWaiting = false; // for the rest of a label, of which a region is to be selected
  pickMs = Number.NaN; // of the last pick
  private seed: Seed | null = null;
  private wasLoading = false;
  private width = DEFAULT_TOLERANCE; // index of TOLERANCES
  private readonly listeners = new Set<() => void>();
  private readonly weighed = new Set<number>(); // labels whose weight edits have set
  private readonly hid = new Set<number>(); // the same of being shown or not
  private readonly labels: ReadonlyMap<number, Label>;

  constructor(readonly viewer: EditableView) {
    const { labels, ladder = null } = viewer.manifest;
    this.labels = new Map(labels.map((label) => [label.id, label]));
    this.edits = new Edits(labels.map(originOf), ladder, () => {
      this.clear();
      this.show();
    });
    viewer.streamer.onChange(() => {
      if (this.isWaiting && this.seed) this.choose(this.seed, "alike");
      else if (this.wasLoading !== this.isLoading) this.notify();
    });
  }

  /** Why labels of this scene cannot be edited; null: they can. */
  get obstacle(): string | null {
    const { ladder, live } = this.viewer.manifest;
    if (live) return "Labels are edited when training has ended.";
    return ladder
      ? null
      : "This bundle does not say which run it is of; bundle the run again to edit labels.";
  }

  onChange(callback: () => void): () => void {
    this.listeners.add(callback);
    return () => this.listeners.delete(callback);
  }

  open(open: boolean): void {
    this.isOpen = open;
    if (!open) this.clear();
    this.show();
  }

  /** Selects what is at a point of the canvas; the same point again: the next scope. */
  pick(x: number, y: number): void {
    const begun = performance.now();
    const seed = this.seed;
    if (seed && this.selection && Math.hypot(seed.x - x, seed.y - y) <= SAME_PLACE) {
      this.cycle();
    } else {
      const found = this.meet(x, y);
      this.clear();
      if (found) this.choose({ ...found, x, y }, this.scopes(found)[0] ?? "category");
    }
    this.pickMs = performance.now() - begun;
    this.notify();
  }

  /** The next scope around the same point. */
  cycle(): void {
    const { seed, selection } = this;
    if (!seed) return;
    const scopes = this.scopes(seed);
    const next = scopes[(scopes.indexOf(selection?.scope ?? "alike") + 1) % scopes.length];
    if (next) this.choose(seed, next);
  }

  setScope(scope: Scope): void {
    if (this.seed) this.choose(this.seed, scope);
  }

  /** Scopes that there are around the selected point. */
  get available(): readonly Scope[] {
    return this.seed ? this.scopes(this.seed) : [];
  }

  /** Takes more, or less, for alike. */
  widen(by: number): void {
    this.width = Math.max(0, Math.min(TOLERANCES.length - 1, this.width + by));
    if (this.seed) this.choose(this.seed, "alike");
  }

  /** Selects categories of the list. */
  selectCategories(numbers: readonly number[]): void {
    this.seed = null;
    this.isWaiting = false;
    const [first] = numbers;
    if (first === undefined) this.clear();
    else
      this.select(
        "category",
        first,
        this.masksOf((owner) => numbers.includes(owner)),
      );
  }

  clear(): void {
    this.seed = null;
    this.isWaiting = false;
    this.selection = null;
    this.show();
  }

  get selected(): Category | null {
    return this.selection ? (this.edits.categories.list[this.selection.category] ?? null) : null;
  }

  /** Whether merged splats are drawn still in place of those that edits are of. */
  get isLoading(): boolean {
    const labels = [...this.labels.values()].filter(replaces);
    const wanted = labels.filter(({ id }) => this.isOpen && !this.viewer.isHidden(id));
    return wanted.some(({ cells }) => !cells.every((cell) => this.cloudOf(cell)));
  }

  /** Applies operations, and selects what they leave; throws where one cannot be. */
  apply(...operations: readonly Operation[]): void {
    const before = this.selectedNumbers;
    for (const operation of operations) this.edits.apply(operation);
    const { list, present } = this.edits.categories;
    const last = operations.at(-1);
    if (last?.op === "merge" || last?.op === "split") {
      const name = last.op === "merge" ? last.into : last.to.normalize("NFC");
      this.selectCategories(present.filter((number) => list[number]?.name === name));
    } else this.selectCategories(before);
  }

  /** The numbers of the categories that the selection has splats of. */
  get selectedNumbers(): number[] {
    const found = new Set<number>();
    for (const [id, mask] of this.selection?.masks ?? []) {
      this.edits.categories.owner.get(id)?.forEach((number, rank) => {
        if (mask[rank]) found.add(number);
      });
    }
    return [...found].sort((a, b) => a - b);
  }

  get selectedCategories(): Category[] {
    return this.selectedNumbers.flatMap((number) => this.edits.categories.list[number] ?? []);
  }

  /** Makes the selection a category of its own. */
  split(to: string): void {
    const { selection, selected } = this;
    if (!selection || !selected) throw new Error("Nothing is selected.");
    if (this.isWaiting) throw new Error("The rest of it is still loading.");
    const gaussians: Record<string, readonly number[]> = {};
    for (const [id, mask] of selection.masks) {
      const label = this.labels.get(id);
      const runs = runsOf(mask);
      if (label && runs.length) gaussians[label.name] = runs;
    }
    this.apply({ op: "split", category: selected.name, to, gaussians: gaussians as Ranks });
  }

  private meet(x: number, y: number): Picked | null {
    const ray = this.viewer.stage.ray(x, y);
    const clouds = [...this.labels.values()].flatMap((label) =>
      placed(label).flatMap(({ cell, first }) => {
        const cloud = this.cloudOf(cell);
        return cloud ? { ...cloud, first } : [];
      }),
    );
    return pick(clouds, ENCODING, ray);
  }

  /** The shown splats of a cell; null where they are merged ones, which have no ranks. */
  private cloudOf(cell: Cell): Packed | null {
    const cloud = this.viewer.stage.layer.splatsOf(cell.id);
    return cloud && (cloud.level ?? 1) > startOf(cell) ? cloud : null;
  }

  private categoryAt({ label, rank }: Picked): number {
    return this.edits.categories.owner.get(label)?.[rank] ?? 0;
  }

  private scopes(found: Picked): Scope[] {
    const hasParent = this.family(this.categoryAt(found)).length > 1;
    return [...(hasParent ? (["instance"] as const) : []), "category", "alike"];
  }

  /** The categories of one parent: all instances of "chair", and what is "chair" without being one of them. */
  private family(number: number): number[] {
    const { list, present } = this.edits.categories;
    const parent = list[number]?.parent ?? list[number]?.name;
    return present.filter((i) => i === number || list[i]?.parent === parent || list[i]?.name === parent);
  }

  private choose(seed: Seed, scope: Scope): void {
    this.seed = seed;
    this.isWaiting = false;
    const category = this.categoryAt(seed);
    const family = scope === "category" ? this.family(category) : [category];
    if (scope === "alike") {
      const region = this.region(seed, category);
      this.isWaiting = region === null;
      if (region) this.select(scope, category, new Map([[seed.label, region]]));
      else this.show();
      return;
    }
    this.select(
      scope,
      category,
      this.masksOf((owner) => family.includes(owner)),
    );
  }

  /** What is alike around the seed; null until all splats of its label are there. */
  private region(seed: Seed, category: number): Uint8Array | null {
    const { layer } = this.viewer.stage;
    const owner = this.edits.categories.owner.get(seed.label);
    const cells = this.labels.get(seed.label)?.cells ?? [];
    const count = cells.reduce((sum, cell) => sum + (this.cloudOf(cell)?.count ?? 0), 0);
    if (!owner || count < owner.length) return null;
    const among = Uint8Array.from(owner, (number) => +(number === category));
    const tolerance = TOLERANCES[this.width] ?? 0.3;
    // the lit colours of an earlier selection would not be alike
    const words = new Uint32Array(4 * count);
    let end = 0;
    for (const { id } of cells) {
      const own = (layer.plainWords(id) ?? new Uint32Array()).subarray(0, words.length - end);
      words.set(own, end);
      end += own.length;
    }
    const cloud: Packed = { label: seed.label, words, count };
    return grow(cloud, ENCODING, seed.rank, tolerance, among);
  }

  private masksOf(isIn: (owner: number) => boolean): Map<number, Uint8Array> {
    const masks = new Map<number, Uint8Array>();
    for (const [id, owner] of this.edits.categories.owner) {
      const mask = Uint8Array.from(owner, (number) => +isIn(number));
      if (mask.includes(1)) masks.set(id, mask);
    }
    return masks;
  }

  private select(scope: Scope, category: number, masks: ReadonlyMap<number, Uint8Array>): void {
    const count = [...masks.values()].reduce((sum, mask) => sum + mask.reduce((a, b) => a + b, 0), 0);
    this.selection = { scope, category, masks, count };
    this.show();
  }

  /** Shows the edits and the selection: marks, hidden labels, weights, what is in full. */
  private show(): void {
    const { viewer } = this;
    const { list, owner } = this.edits.categories;
    const weights = new Map(viewer.settings.weights);
    const always = new Map<number, boolean>();
    for (const [id, numbers] of owner) {
      const label = this.labels.get(id) as Label;
      const own = [...new Set(numbers)].flatMap((number) => list[number] ?? []);
      const weight = Math.max(...own.map((one) => one.weight));
      const hidden = own.every((one) => one.hidden);
      // what edits do not touch stays as the panel set it
      if (this.touches(this.weighed, id, weight !== label.weight)) weights.set(id, weight);
      if (this.touches(this.hid, id, hidden !== (label.hidden ?? false))) this.hide(id, hidden);
      const waits = this.isWaiting && this.seed?.label === id;
      // edits are of the last level, which merged splats below it are not part of
      const last = replaces(label) && (this.isOpen || own.length > 1);
      const full = waits || last || own.some((one) => one.always);
      if (full !== label.always) always.set(id, full);
      const marks = this.marksOf(id, numbers);
      for (const { cell, first } of placed(label)) {
        viewer.stage.layer.setMarks(cell.id, marks?.slice(first, first + countOf(cell)) ?? null);
      }
    }
    viewer.set({ weights, always });
    this.notify();
  }

  /** Whether a label is, or was until now, other than the manifest has it. */
  private touches(touched: Set<number>, id: number, differs: boolean): boolean {
    if (differs) touched.add(id);
    return differs || touched.delete(id);
  }

  private hide(id: number, hidden: boolean): void {
    if (this.viewer.isHidden(id) !== hidden) this.viewer.setHidden([id], hidden);
  }

  private marksOf(id: number, numbers: Int32Array): Uint8Array | null {
    const { list } = this.edits.categories;
    const selected = this.isOpen ? this.selection?.masks.get(id) : undefined;
    const partly = new Set(numbers).size > 1 && [...numbers].some((number) => list[number]?.hidden);
    if (!selected && !partly) return null;
    return Uint8Array.from(numbers, (number, rank) => {
      if (partly && list[number]?.hidden) return Mark.hidden;
      return selected?.[rank] ? Mark.lit : Mark.plain;
    });
  }

  private notify(): void {
    this.wasLoading = this.isLoading;
    for (const callback of this.listeners) callback();
  }
}

const originOf = (label: Label): Origin => ({
  id: label.id,
  name: label.name,
  title: label.title,
  ...(label.parent !== undefined && { parent: label.parent }),
  count: label.cells.reduce((sum, cell) => sum + countOf(cell), 0),
  weight: label.weight,
  always: label.always,
  hidden: label.hidden ?? false,
});

/** Number of a cell's increments that its last level does not have, since it or one below it replaces them. */
const startOf = ({ levels }: Cell): number => levels.map(({ refine }) => !!refine).lastIndexOf(true);

/** Splats of a cell's last level. */
const countOf = (cell: Cell): number =>
  cell.levels.slice(Math.max(0, startOf(cell))).reduce((sum, { count }) => sum + count, 0);

const replaces = ({ cells }: Label): boolean => cells.some((cell) => startOf(cell) > 0);

/** The cells of a label, each with the rank of its first splat: a label's ranks go through its cells in turn. */
function placed({ cells }: Label): { cell: Cell; first: number }[] {
  let end = 0;
  return cells.map((cell) => {
    const first = end;
    end += countOf(cell);
    return { cell, first };
  });
}
