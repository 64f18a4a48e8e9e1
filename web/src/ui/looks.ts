import { bytesFrom } from "../inside";
import type { Manifest, Settings } from "../types";
import type { Viewer } from "../view/viewer";
import { h, setText } from "./dom";
import { formatSsim } from "./format";

/** What the slider's fidelity looks like, beside the full scene: a part of a view at each. */
export class Looks {
  readonly element: HTMLElement;
  readonly #name = h("small");
  readonly #parts = [h("i"), h("i")] as const;

  constructor(
    readonly viewer: Viewer,
    readonly looks: NonNullable<Manifest["looks"]>,
  ) {
    const [asked, full] = this.#parts;
    this.element = h(
      "span",
      { class: "looks", hidden: true },
      h("span", {}, asked, this.#name),
      h("span", {}, full, h("small", {}, "full")),
    );
  }

  /** Fetches the picture. Without it the words beside the slider stay alone. */
  async show(): Promise<void> {
    try {
      const content = await bytesFrom(this.viewer.source, this.looks.uri);
      const picture = new Image();
      picture.src = URL.createObjectURL(new Blob([content], { type: "image/jpeg" }));
      await picture.decode();
      const count = this.looks.targets.length;
      for (const part of this.#parts) {
        part.style.backgroundImage = `url("${picture.src}")`;
        part.style.backgroundSize = `${100 * count}% 100%`;
        part.style.aspectRatio = `${picture.naturalWidth / count} / ${picture.naturalHeight}`;
      }
      this.element.hidden = false;
      this.update(this.viewer.settings);
    } catch {}
  }

  update({ quality, target }: Settings): void {
    const { targets } = this.looks;
    const last = targets.length - 1;
    const nearest = nearestOf(targets.slice(0, last), target);
    setText(this.#name, formatSsim(targets[nearest] ?? 1));
    this.element.classList.toggle("other", quality !== "fidelity");
    [nearest, last].forEach((place, i) => {
      const part = this.#parts[i];
      if (part) part.style.backgroundPositionX = `${(100 * place) / last}%`;
    });
  }
}

/** The place of the value that is nearest. */
function nearestOf(values: readonly number[], wanted: number): number {
  const far = values.map((value) => Math.abs(value - wanted));
  return far.indexOf(Math.min(...far));
}
