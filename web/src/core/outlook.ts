/** What each label looks like from where the viewer stands: its distance, quality and share of the pixels. */

import type { Label, Promises, Settings, Viewpoint } from "../types";
import { look } from "./distance";
import type { Candidate } from "./planner";
import { byDistance, ViewModel, Views } from "./quality";
import type { Entry } from "./residency";

/** Without promises levels are judged by the distance, shares of pixels by the size of the boxes. */
export class Outlook {
  readonly complete: boolean; // whether it has the promises
  private readonly models = new Map<number, ViewModel>();

  constructor(labels: readonly Label[] = [], promises: Promises | null = null) {
    this.complete = promises !== null;
    if (!promises) return;
    const views = new Views(promises);
    const byId = new Map(labels.map((label) => [label.id, label]));
    for (const own of promises.labels) {
      const label = byId.get(own.id);
      if (label && ViewModel.fits(label, own)) this.models.set(own.id, new ViewModel(label, views, own));
    }
  }

  /** Brings what is known of a label to a viewpoint. */
  see(entry: Entry, viewpoint: Viewpoint): void {
    const { label } = entry;
    const { position, direction } = viewpoint;
    const model = this.models.get(label.id);
    const seen = look(label.boxes, viewpoint);
    if (!seen.visible && label.boxes.length) {
      // no plan depends on what nobody sees: that it is not computed keeps scenes of many parts fast
      entry.sight = seen;
      entry.prediction = entry.unseen;
      entry.share = seen.size;
      return;
    }
    const distance = model?.corrected(seen.distance, position, direction) ?? seen.distance;
    const sight = { ...seen, distance };
    // a label of which nobody knows where it is may be anywhere
    entry.sight = label.boxes.length ? sight : { ...sight, visible: true };
    entry.prediction = model?.predict(distance, position, direction) ?? byDistance(label, distance);
    entry.share = model ? model.share(position, direction) : this.complete ? 0 : sight.size;
  }

  /** What a label is to be planned with. */
  candidate(entry: Entry, weights: Settings["weights"], highest: number): Candidate {
    const { label, ladder, prediction, sight, share, wanted } = entry;
    return {
      label,
      ladder,
      highest,
      mean: prediction.mean,
      bound: prediction.bound,
      weight: weights.get(label.id) ?? label.weight,
      share,
      visible: sight.visible,
      previous: wanted,
    };
  }
}
