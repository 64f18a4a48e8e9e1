import { h } from "./dom";

const HELP: readonly (readonly [string, string])[] = [
  ["Drag", "turn around the scene, or look around when walking"],
  ["Right drag, two fingers", "move sideways"],
  ["Wheel, pinch", "closer, further"],
  ["W A S D", "move; Q and E down and up, Shift faster"],
  ["Arrow keys", "turn"],
  ["O", "orbit or walk"],
  ["[ and ]", "photo before, photo after"],
  ["C", "compare with the full scene"],
  ["T", "colour the labels; in a scene in blocks the blocks, too"],
  ["P", "open or close the panel"],
  ["Gamepad", "left stick moves, right stick turns"],
  ["Headset", "left stick moves, right stick turns"],
];

/** What one can do, as a dialog that Escape closes. */
export function helpDialog(): HTMLDialogElement {
  const rows = HELP.flatMap(([key, text]) => [h("dt", {}, key), h("dd", {}, text)]);
  const close = h("button", { type: "button", class: "primary", click: () => dialog.close() }, "Close");
  const note = h(
    "p",
    { class: "hint" },
    "Each label has levels of detail. Quality finds the smallest levels that keep what you ask for from where you stand; budget finds the best levels that fit.",
  );
  const dialog = h(
    "dialog",
    { class: "help card", "aria-labelledby": "help-title" },
    h("h2", { id: "help-title", tabindex: -1, autofocus: true }, "Finding your way"),
    h("dl", {}, ...rows),
    note,
    close,
  );
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close();
  });
  return dialog;
}
