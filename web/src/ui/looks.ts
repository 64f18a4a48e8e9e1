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
  #asked = false;

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
    if (this.#asked) return;
    this.#asked = true;
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
    const below = targets.findLastIndex((one, place) => place < last && one <= target); // nothing better is shown
    setText(this.#name, formatSsim(targets[below] ?? 1));
    this.element.classList.toggle("other", quality !== "fidelity" || below < 0);
    [below, last].forEach((place, i) => {
      const part = this.#parts[i];
      if (part) part.style.backgroundPositionX = `${(100 * place) / last}%`;
    });
  }
}
