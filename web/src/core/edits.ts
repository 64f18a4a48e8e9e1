/** Edits of labels: what they make of the categories, undo and redo, and labels.edit.json (docs/formats.md). */

import { checkedName } from "./names";

export const FORMAT = "sagesplat-label-edits";
export const VERSION = 1;
const UNLABELLED = "unlabelled";
const MAX_WEIGHT = 1e6;

/** Ranks in the order of the ladder, by category of the run: first, number, first, number, ... */
export type Ranks = Readonly<Record<string, readonly number[]>>;

export type Operation =
  | { readonly op: "rename"; readonly category: string; readonly to: string }
  | { readonly op: "merge"; readonly category: string; readonly into: string }
  | { readonly op: "split"; readonly category: string; readonly to: string; readonly gaussians: Ranks }
  | { readonly op: "hide"; readonly category: string; readonly hidden: boolean }
  | { readonly op: "weigh"; readonly category: string; readonly weight: number }
  | { readonly op: "full"; readonly category: string; readonly always: boolean };

/** A category of the run, as the manifest has it. */
export interface Origin {
  readonly id: number;
  readonly name: string;
  readonly title: string;
  readonly parent?: string; // of an instance: the name of its category
  readonly count: number; // splats of the last level
  readonly weight: number;
  readonly always: boolean;
  readonly hidden: boolean;
}

export interface Category {
  name: string;
  title: string;
  readonly parent: string | null;
  weight: number;
  always: boolean;
  hidden: boolean;
}

/** The categories after some edits; `owner` has the number of each splat's category, by label id and rank. */
export class Categories {
  readonly list: Category[];
  readonly owner = new Map<number, Int32Array>();
  private readonly ids = new Map<string, number>(); // by the run's own names

  constructor(origins: readonly Origin[]) {
    this.list = origins.map(({ name, title, parent = null, weight, always, hidden }) => {
      return { name, title, parent, weight, always, hidden };
    });
    origins.forEach(({ id, name, count }, number) => {
      this.owner.set(id, new Int32Array(count).fill(number));
      this.ids.set(name, id);
    });
  }

  /** The numbers of the categories that have splats. */
  get present(): number[] {
    const found = new Set<number>();
    for (const owner of this.owner.values()) for (const number of owner) found.add(number);
    return [...found].sort((a, b) => a - b);
  }

  /** Splats of each category, by its number. */
  counts(): number[] {
    const counts = new Array<number>(this.list.length).fill(0);
    for (const owner of this.owner.values())
      for (const number of owner) counts[number] = (counts[number] ?? 0) + 1;
    return counts;
  }

  /** The number of a category; throws for an unknown one. */
  find(name: string): number {
    const number = this.present.find((i) => this.list[i]?.name === name);
    if (number === undefined) throw new Error(`There is no category ${name}.`);
    return number;
  }

  apply(operation: Operation): void {
    const number = this.find(operation.category);
    const category = this.list[number] as Category;
    switch (operation.op) {
      case "rename":
        this.rename(category, operation.to);
        break;
      case "merge":
        this.merge(number, this.find(operation.into));
        break;
      case "split":
        this.split(number, operation.to, operation.gaussians);
        break;
      case "hide":
        category.hidden = operation.hidden;
        break;
      case "weigh":
        if (!(operation.weight >= 0 && operation.weight <= MAX_WEIGHT))
          throw new Error("A weight is a number from 0 on.");
        category.weight = operation.weight;
        break;
      case "full":
        category.always = operation.always;
        break;
    }
  }

  private free(given: string): string {
    const name = checkedName(given);
    if (name === UNLABELLED || this.present.some((i) => this.list[i]?.name === name)) {
      throw new Error(`The name ${name} is taken; choose another, or merge the two.`);
    }
    return name;
  }

  private rename(category: Category, to: string): void {
    if (to === category.name) return;
    category.name = this.free(to);
    category.title = category.name;
  }

  private merge(number: number, into: number): void {
    if (number === into) throw new Error("A category cannot be merged with itself.");
    for (const owner of this.owner.values()) {
      for (let i = 0; i < owner.length; i++) if (owner[i] === number) owner[i] = into;
    }
    if (this.present.every((i) => this.list[i]?.name === UNLABELLED)) {
      throw new Error("This would leave no category.");
    }
  }

  private split(number: number, to: string, gaussians: Ranks): void {
    const name = this.free(to);
    const created = this.list.length;
    let count = 0;
    for (const [label, runs] of Object.entries(gaussians)) {
      const owner = this.owner.get(this.ids.get(label) ?? Number.NaN);
      if (!owner) throw new Error(`There is no category ${label} in this run.`);
      for (const rank of ranksOf(runs, owner.length)) {
        if (owner[rank] !== number) throw new Error("Some of the selection is of another category.");
        owner[rank] = created;
        count += 1;
      }
    }
    if (!count) throw new Error("Nothing is selected.");
    if (!this.present.includes(number)) throw new Error("Nothing would be left of it; rename it instead.");
    const parent = this.list[number]?.parent ?? null;
    this.list.push({ name, title: name, parent, weight: 1, always: false, hidden: false });
  }
}

function* ranksOf(runs: readonly number[], length: number): Generator<number> {
  let end = 0;
  for (let i = 0; i < runs.length; i += 2) {
    const [first, number] = [runs[i] ?? -1, runs[i + 1] ?? 0];
    if (!(first >= end && number > 0 && first + number <= length))
      throw new Error("Ranks that there are not.");
    end = first + number;
    for (let rank = first; rank < end; rank++) yield rank;
  }
}

/** The ranks where a mask is not 0, as runs. */
export function runsOf(mask: Uint8Array): number[] {
  const runs: number[] = [];
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i]) continue;
    if (i > 0 && mask[i - 1]) runs[runs.length - 1] = (runs.at(-1) ?? 0) + 1;
    else runs.push(i, 1);
  }
  return runs;
}

/** A list of operations with undo and redo. Every change calls back. */
export class Edits {
  categories: Categories;
  private done: Operation[] = [];
  private undone: Operation[] = [];

  constructor(
    private readonly origins: readonly Origin[],
    readonly ladder: string | null,
    private readonly changed: () => void = () => {},
  ) {
    this.categories = new Categories(origins);
  }

  get operations(): readonly Operation[] {
    return this.done;
  }

  get canUndo(): boolean {
    return this.done.length > 0;
  }

  get canRedo(): boolean {
    return this.undone.length > 0;
  }

  /** Applies an operation; throws, and changes nothing, where that cannot be. */
  apply(operation: Operation): void {
    this.become([...this.done, operation]);
    this.undone = [];
    this.changed();
  }

  undo(): void {
    const last = this.done.at(-1);
    if (!last) return;
    this.become(this.done.slice(0, -1));
    this.undone.push(last);
    this.changed();
  }

  redo(): void {
    const next = this.undone.pop();
    if (!next) return;
    this.become([...this.done, next]);
    this.changed();
  }

  /** The content of labels.edit.json. */
  dump(): string {
    const document = { format: FORMAT, version: VERSION, ladder: this.ladder, operations: this.done };
    return `${JSON.stringify(document, null, 1)}\n`;
  }

  /** Takes over a labels.edit.json; throws in one line where it is damaged or of another run. */
  load(json: string): void {
    this.become(parseEdits(json, this.ladder));
    this.undone = [];
    this.changed();
  }

  private become(operations: Operation[]): void {
    const categories = new Categories(this.origins);
    for (const operation of operations) categories.apply(operation);
    this.categories = categories;
    this.done = operations;
  }
}

function parseEdits(json: string, ladder: string | null): Operation[] {
  let found: unknown;
  try {
    found = JSON.parse(json);
  } catch {
    found = null;
  }
  const document = (typeof found === "object" && found !== null ? found : {}) as Record<string, unknown>;
  const { format, version, operations } = document;
  if (format !== FORMAT || typeof version !== "number") throw new Error("Not a file of label edits.");
  if (version > VERSION) throw new Error(`Edits of version ${version}; this viewer reads up to ${VERSION}.`);
  if (document.ladder !== ladder) throw new Error("Edits of another run, or of its earlier levels.");
  if (!Array.isArray(operations) || !operations.every(isOperation)) throw new Error("Damaged label edits.");
  return operations;
}

const FIELDS: Readonly<Record<Operation["op"], Readonly<Record<string, string>>>> = {
  rename: { to: "string" },
  merge: { into: "string" },
  split: { to: "string", gaussians: "object" },
  hide: { hidden: "boolean" },
  weigh: { weight: "number" },
  full: { always: "boolean" },
};

function isOperation(one: unknown): one is Operation {
  if (typeof one !== "object" || one === null) return false;
  const entry = one as Record<string, unknown>;
  const fields =
    typeof entry.op === "string" && Object.hasOwn(FIELDS, entry.op) && FIELDS[entry.op as "hide"];
  if (!fields || typeof entry.category !== "string") return false;
  if (!Object.entries(fields).every(([key, type]) => typeof entry[key] === type)) return false;
  const { gaussians } = entry;
  return !("gaussians" in fields) || Object.values(gaussians ?? []).every(Array.isArray);
}
