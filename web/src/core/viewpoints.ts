/** Each cell from the current viewpoint: distance, quality and pixel share; and what its label keeps. */

import type { Label, Promises, Quality, Settings, Viewpoint } from "../types";
import { Points } from "./distance";
import type { File } from "./download";
import { type Candidate, type Group, LEAST_SHARE } from "./planner";
import {
  boundOf,
  keptByLast,
  LabelModel,
  levelsOf,
  meansAnywhere,
  neededFor,
  type Outlook,
  outlookAnywhere,
  Views,
} from "./quality";
import type { Entry } from "./residency";

/** The cells of a label. */
export interface Family {
  readonly label: Label;
  readonly entries: readonly Entry[];
  outlook: Outlook;
}

const NOTHING: Outlook = { keeps: null, support: Number.NaN, trust: "unknown" };

/** Entries by their labels, in the order of these. */
export function familiesOf(entries: readonly Entry[]): Family[] {
  const byLabel = new Map<Label, Entry[]>();
  for (const entry of entries) {
    const known = byLabel.get(entry.label);
    if (known) known.push(entry);
    else byLabel.set(entry.label, [entry]);
  }
  return [...byLabel].map(([label, own]) => ({ label, entries: own, outlook: NOTHING }));
}

/** Without viewpoint models, quality is the same everywhere and pixel share is the apparent size. */
export class ViewpointModels {
  private readonly models = new Map<number, LabelModel>(); // by label id
  private readonly views: Views | null;

  constructor(
    readonly quality: Quality,
    labels: readonly Label[] = [],
    readonly promises: Promises | null = null,
  ) {
    this.views = promises && new Views(promises);
    const byId = new Map(labels.map((label) => [label.id, label]));
    for (const own of promises?.labels ?? []) {
      const label = byId.get(own.id);
      if (label && this.views && LabelModel.fits(label, own)) {
        this.models.set(own.id, new LabelModel(label, this.views, own));
      }
    }
  }

  /** Whether it has the viewpoint models. */
  get complete(): boolean {
    return this.promises !== null;
  }

  /** Evaluates all cells at the viewpoint. */
  see(families: readonly Family[], viewpoint: Viewpoint): void {
    this.views?.from(viewpoint);
    let total = 0;
    for (const family of families) {
      for (const entry of family.entries) entry.sight = entry.points.look(viewpoint);
      this.predict(family);
      for (const { share } of family.entries) total += share;
    }
    const whole = Math.max(1, total);
    for (const family of families) {
      let [last, seen] = [0, 0];
      for (const entry of family.entries) {
        entry.share = entry.sight.visible ? Math.max(entry.share / whole, LEAST_SHARE) : 0;
        if (entry.share > 0) last += entry.share * (entry.mean.at(-1) ?? Number.NaN);
        seen += entry.share;
      }
      if (this.models.get(family.label.id)?.whole === null)
        family.outlook = keptByLast(family.outlook, last / seen);
    }
  }

  private predict(family: Family): void {
    const { label, entries } = family;
    const model = this.models.get(label.id);
    const isSeen = entries.some(({ sight }) => sight.visible);
    // plans do not depend on what is out of sight; skipping it keeps large scenes fast
    const known = label.quality[this.quality];
    const whole = isSeen ? model?.whole : null;
    const distance = whole?.corrected(Points.together(entries.map(({ points }) => points)));
    family.outlook = model && isSeen ? model.outlook(distance) : outlookAnywhere(known);
    const means = whole?.mean(distance ?? Number.NaN) ?? meansAnywhere(known, levelsOf(label));
    for (const [i, entry] of entries.entries()) {
      const own = this.isByLabel || !entry.sight.visible ? undefined : model?.cells[i];
      entry.mean = own?.mean(entry.sight.distance) ?? means.slice(0, entry.cell.levels.length);
      entry.share = entry.sight.apparent * (own?.factor() ?? 1);
    }
  }

  /** Whether quality is of labels as a whole, whose cells have one level. */
  get isByLabel(): boolean {
    return this.quality === "ssim";
  }

  /** The planner's input for a label, whose entries' candidates are renewed. */
  group(
    { label, entries, outlook }: Family,
    settings: Settings,
    highest: (entry: Entry) => number,
    isHere: (file: File) => boolean,
  ): Group {
    const { keeps } = outlook;
    const weight = settings.weights.get(label.id) ?? label.weight;
    const always = settings.always?.get(label.id) ?? label.always;
    const cells = entries.map((entry) => {
      const { ladder, mean, share, sight, wanted } = entry;
      const { potential, visible } = sight;
      entry.candidate = {
        ladder,
        effort: visible && settings.mode === "target" ? entry.effort(isHere) : ladder.bytes,
        highest: highest(entry),
        mean,
        weight,
        always,
        share,
        potential,
        visible,
        previous: wanted,
      };
      return entry.candidate;
    });
    const needed = keeps ? neededFor(keeps, settings.target) : Number.NaN;
    if (!this.isByLabel) return { cells, needed };
    const one = asOne(cells);
    return {
      cells: [one],
      needed,
      bound: one.mean.map((mean) => (keeps ? boundOf(keeps, mean) : Number.NaN)),
    };
  }
}

/** The cells of a label as one, all at the same level, or at their last one. */
function asOne(cells: readonly Candidate[]): Candidate {
  const [first] = cells as readonly [Candidate];
  const longest = cells.reduce((a, b) => (b.mean.length > a.mean.length ? b : a), first);
  const sum = (of: (c: Candidate) => number) => cells.reduce((all, c) => all + of(c), 0);
  const added = (of: (c: Candidate) => readonly number[]) =>
    longest.mean.map((_, k) => sum((c) => of(c)[Math.min(k, of(c).length - 1)] ?? 0));
  const costs = (unit: keyof Candidate["ladder"]) => added(({ ladder }) => ladder[unit]);
  // a damaged increment holds back those cells only that have it
  const limit = Math.max(...cells.map((c) => c.highest));
  return {
    ...first,
    ladder: { bytes: costs("bytes"), gpuBytes: costs("gpuBytes"), count: costs("count") },
    effort: added(({ effort }) => effort),
    highest: limit,
    mean: longest.mean,
    share: sum(({ share }) => share),
    potential: sum(({ potential }) => potential),
    visible: cells.some(({ visible }) => visible),
    previous: Math.max(...cells.map(({ previous }) => previous)),
  };
}
