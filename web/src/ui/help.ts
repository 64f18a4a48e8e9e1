import { h, isTouch, textButton } from "./dom";

const TOUCH: readonly (readonly [string, string])[] = [
  ["Drag", "orbit the scene, or look around in walk mode"],
  ["Two fingers", "walk: drag them down to go ahead, aside to go aside"],
  ["Pinch", "move closer or farther"],
];
const HELP: readonly (readonly [string, string])[] = [
  ["Drag", "orbit the scene, or look around in walk mode"],
  ["Right drag", "move sideways"],
  ["Wheel", "move closer or farther"],
  ["W A S D", "move; Q and E down and up, Shift faster"],
  ["Arrow keys", "turn"],
  ["O", "orbit or walk"],
  ["[ and ]", "previous PHOTO, next PHOTO"],
  ["C", "compare with the full scene"],
  ["T", "colour by category, then by cell: the parts that have levels of their own"],
  ["L", "edit labels: click, or aim with the cross and press Enter; again for more or less of it"],
  ["H, F, + and -", "while editing: hide, always in full, more or less alike; Ctrl Z undoes"],
  ["P", "open or close the panel"],
  ["Gamepad", "left stick moves, right stick turns"],
  ["Headset", "left stick moves, right stick turns"],
];

/**
 * The help dialog; Escape closes it.
 *
 * @param photo - what one of the cameras is called
 */
export function helpDialog(photo: string): HTMLDialogElement {
  const rows = (isTouch() ? TOUCH : HELP).flatMap(([key, text]) => [
    h("dt", {}, key),
    h("dd", {}, text.replaceAll("PHOTO", photo)),
  ]);
  const close = textButton("Close", "primary", () => dialog.close());
  const note = h(
    "p",
    { class: "hint" },
    "Every category has levels of detail. Quality chooses the smallest levels whose promised quality reaches the target from where you are; Budget chooses the best levels that fit. Quality is SSIM: against the full scene seen from the same place (fidelity), or against the photos. A promise is a lower bound that holds in 95 of 100 decisions, tried at viewpoints that nothing was fitted to, on screens of the sharpness that the panel names; while something in sight is missing, none is given. Far from all viewpoints that were tried there is no promise: the category is then shown in full.",
  );
  const dialog = h(
    "dialog",
    { class: "help card", "aria-labelledby": "help-title" },
    h("h2", { id: "help-title", tabindex: -1, autofocus: true }, "Controls"),
    h("dl", {}, ...rows),
    note,
    close,
  );
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close();
  });
  return dialog;
}
