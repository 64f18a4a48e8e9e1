/** Each label from the current viewpoint: distance, quality and pixel share. */

import type { Label, Promises, Quality, Settings, Viewpoint } from "../types";
import { look } from "./distance";
import type { Candidate } from "./planner";
import { anywhere, type Prediction, ViewModel, Views } from "./quality";
import type { Entry } from "./residency";

/** Without viewpoint models, quality is the same everywhere and pixel share depends on the size of the boxes. */
export class ViewpointModels {
  private readonly models = new Map<number, ViewModel>();
  private readonly wherever = new Map<number, Prediction>(); // without a viewpoint model, or out of sight

  constructor(
    readonly quality: Quality,
    labels: readonly Label[] = [],
    readonly promises: Promises | null = null,
  ) {
    for (const label of labels) this.wherever.set(label.id, anywhere(label, quality));
    if (!promises) return;
    const views = new Views(promises);
    const byId = new Map(labels.map((label) => [label.id, label]));
    for (const own of promises.labels) {
      const label = byId.get(own.id);
      if (label && ViewModel.fits(label, own)) this.models.set(own.id, new ViewModel(label, views, own));
    }
  }

  /** Whether it has the viewpoint models. */
  get complete(): boolean {
    return this.promises !== null;
  }

  /** Evaluates a label at the viewpoint; `photo`: its `photoFrustum`. */
  see(entry: Entry, viewpoint: Viewpoint, photo: Viewpoint["frustum"] = viewpoint.frustum): void {
    const { label } = entry;
    const model = this.models.get(label.id);
    const seen = look(label.boxes, viewpoint, photo);
    if (!seen.visible && label.boxes.length) {
      // plans do not depend on labels out of sight; skipping them keeps scenes in blocks fast
      entry.sight = seen;
      entry.prediction = this.elsewhere(label);
      entry.share = seen.size;
      return;
    }
    const distance = model?.corrected(seen.distance, viewpoint) ?? seen.distance;
    const sight = { ...seen, distance };
    // a label without boxes may be anywhere
    entry.sight = label.boxes.length ? sight : { ...sight, visible: true };
    entry.prediction = model?.predict(distance, viewpoint) ?? this.elsewhere(label);
    entry.share = model ? model.share(viewpoint) : this.complete ? 0 : sight.size;
  }

  private elsewhere(label: Label): Prediction {
    return this.wherever.get(label.id) ?? anywhere(label, this.quality);
  }

  /** The planner's input for a label. */
  candidate(
    entry: Entry,
    { weights, always }: Pick<Settings, "weights" | "always">,
    highest: number,
  ): Candidate {
    const full = always?.get(entry.label.id);
    const { label, ladder, prediction, sight, share, wanted } = entry;
    return {
      label,
      ...(full === undefined ? {} : { always: full }),
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
