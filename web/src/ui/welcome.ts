import { remember, remembered } from "../core/storage";
import { h, isTouch, textButton } from "./dom";

const KEY = "sagesplat-welcome";
const MOUSE = "Drag to turn, scroll to come closer, W A S D to walk.";
const TOUCH = "Drag to turn, pinch to come closer, two fingers walk.";
const WHAT = "Each part of the scene loads only as finely as it needs to; the slider sets how finely.";

/** Two lines for newcomers; gone at the first touch of the scene, and not shown again. */
export function welcome(canvas: HTMLElement): HTMLElement | null {
  if (remembered(KEY) !== null) return null;
  const how = isTouch() ? TOUCH : MOUSE;
  const close = textButton("Got it", "primary", () => done());
  const element = h("div", { class: "welcome" }, h("p", {}, h("b", {}, how)), h("p", {}, WHAT), close);
  const done = () => {
    element.remove();
    remember(KEY, "seen");
  };
  for (const event of ["pointerdown", "wheel", "keydown"] as const) {
    canvas.addEventListener(event, done, { once: true });
  }
  return element;
}
