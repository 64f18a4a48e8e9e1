import type { Viewer } from "../view/viewer";
import { h } from "./dom";

export interface Split {
  readonly element: HTMLElement;
  toggle(): void;
  update(): void;
}

/** The divider between the full and the adapted scene; a range input, so that keys can move it. */
export function splitSlider(viewer: Viewer): Split {
  const range = h("input", {
    type: "range",
    min: 2,
    max: 98,
    value: 50,
    "aria-label": "Share of the window that shows the full scene",
    input: () => move(),
  });
  const grip = h("span", { class: "grip", "aria-hidden": "true" });
  const names = [h("span", { class: "left" }, "full"), h("span", { class: "right" }, "adapted")];
  const element = h("div", { class: "split", hidden: true }, ...names, grip, range);
  grip.addEventListener("pointerdown", (event) => grip.setPointerCapture(event.pointerId));
  grip.addEventListener("pointermove", (event) => {
    if (!grip.hasPointerCapture(event.pointerId)) return;
    range.valueAsNumber = (100 * event.clientX) / Math.max(element.clientWidth, 1);
    move();
  });

  function move(): void {
    viewer.stage.split = range.valueAsNumber / 100;
    element.style.setProperty("--split", String(viewer.stage.split));
    viewer.stage.invalidate();
  }

  function update(): void {
    element.hidden = !viewer.stage.isSplit;
    element.classList.toggle("off", viewer.headset.session !== null);
  }

  return {
    element,
    toggle: () => {
      if (viewer.compare.on) viewer.compare.stop();
      else viewer.startCompare();
      update();
      move();
    },
    update,
  };
}
