import { qualitiesOf } from "../core/manifest";
import type { Manifest } from "../types";
import { isTyping } from "../view/controls";
import type { Viewer } from "../view/viewer";
import { offered, type XrMode } from "../view/xr";
import { h, iconButton, isTouch, setIcon, textButton } from "./dom";
import type { EditorCard } from "./editor";
import { messageOf } from "./notice";
import type { Split } from "./split";
import { nextTheme } from "./theme";

const TINT = 0.75; // share of the label colour

interface Parts {
  readonly split: Split;
  readonly help: HTMLDialogElement;
  readonly editor: EditorCard;
  readonly say: (message: string) => void;
}

/** The toolbar: camera, photos, comparison, colours, help and headset, with keyboard shortcuts. */
export function toolbar(viewer: Viewer, parts: Parts): { element: HTMLElement; update(): void } {
  const parted = viewer.manifest.labels.some(({ cells }) => cells.length > 1);
  const tints = parted ? 3 : 2; // none, by label, by cell
  let tinted = 0;
  const mode = iconButton("orbit", "Orbit or walk (O)", () => {
    viewer.controls.mode = viewer.controls.mode === "orbit" ? "walk" : "orbit";
    setIcon(mode, viewer.controls.mode);
    parts.say(
      viewer.controls.mode === "orbit"
        ? "Drag to orbit the scene"
        : `Drag to look around, ${isTouch() ? "two fingers" : "W A S D"} to walk`,
    );
  });
  const compare = iconButton("compare", "Compare with the full scene (C)", () => parts.split.toggle());
  const tint = iconButton("tint", "Colour by category (T)", () => {
    tinted = (tinted + 1) % tints;
    viewer.setTint(tinted ? TINT : 0, tinted === 2);
    if (parted) parts.say(["Original colours", "Coloured by category", "Coloured by cell"][tinted] ?? "");
  });
  const help = iconButton("help", "Help (?)", () => parts.help.showModal());
  const theme = iconButton("theme", "Light or dark", () => parts.say(`Theme: ${nextTheme()}`));
  const edit = iconButton("edit", "Edit labels (L)", () => parts.editor.toggle());
  const photos = photoPicker(viewer);
  const element = h("nav", { class: "toolbar card", "aria-label": "View" });
  element.append(mode, ...photos.elements, compare, tint, edit, help, theme);
  void addHeadsets(element, viewer, parts.say);

  const keys: Record<string, () => void> = {
    o: () => mode.click(),
    c: () => compare.click(),
    t: () => tint.click(),
    l: () => edit.click(),
    "?": () => help.click(),
    "[": () => photos.step(-1),
    "]": () => photos.step(1),
  };
  window.addEventListener("keydown", (event) => {
    if (!isTyping(event) && !event.ctrlKey && !event.altKey && !event.metaKey) keys[event.key]?.();
  });

  return {
    element,
    update: () => {
      compare.setAttribute("aria-pressed", String(viewer.compare.on));
      tint.setAttribute("aria-pressed", String(tinted > 0));
      edit.setAttribute("aria-pressed", String(parts.editor.editor.isOpen));
      photos.update();
    },
  };
}

/** What the manifest's cameras are called: an adopted scene has viewpoints, and no photos. */
export const photosOf = (manifest: Manifest): "photo" | "viewpoint" =>
  qualitiesOf(manifest).includes("ssim") ? "photo" : "viewpoint";

function photoPicker(viewer: Viewer): { elements: HTMLElement[]; step(by: number): void; update(): void } {
  const { cameras } = viewer.manifest;
  const kind = photosOf(viewer.manifest);
  const go = (index: number) => {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    viewer.goTo((index + cameras.length) % cameras.length, !still);
  };
  const step = (by: number) => cameras.length && go(viewer.photo < 0 ? (by > 0 ? 0 : -1) : viewer.photo + by);
  const options = cameras.map(({ name }, i) => h("option", { value: i }, name));
  const select = h(
    "select",
    {
      "aria-label": `Position of a ${kind}`,
      change: () => select.value !== "-1" && go(Number(select.value)),
    },
    h("option", { value: -1 }, kind === "photo" ? "Photos" : "Viewpoints"),
    ...options,
  );
  return {
    elements: cameras.length
      ? [
          h(
            "span",
            { class: "photos" },
            iconButton("previous", `Previous ${kind} ([)`, () => step(-1)),
            select,
            iconButton("next", `Next ${kind} (])`, () => step(1)),
          ),
        ]
      : [],
    step,
    update: () => {
      if (document.activeElement !== select) select.value = String(viewer.photo);
    },
  };
}

async function addHeadsets(
  element: HTMLElement,
  viewer: Viewer,
  say: (message: string) => void,
): Promise<void> {
  const { headset } = viewer;
  const names: Record<XrMode, string> = { "immersive-vr": "VR", "immersive-ar": "AR" };
  const modes = await offered();
  for (const mode of modes) {
    const enter = () => {
      const change = headset.session ? headset.leave() : headset.enter(mode);
      change.catch((error: unknown) => say(`${names[mode]} did not start: ${messageOf(error)}`));
    };
    const title = `Enter ${names[mode]}`;
    element.append(textButton(names[mode], "text", enter, { title }));
  }
  if (!modes.length) return;
  const turn = () => {
    headset.turning = headset.turning === "snap" ? "smooth" : "snap";
    turning.textContent = headset.turning === "snap" ? "Snap" : "Smooth";
  };
  const turning = textButton("Snap", "text", turn, { title: "Turning in the headset: snap or smooth" });
  element.append(turning);
}
