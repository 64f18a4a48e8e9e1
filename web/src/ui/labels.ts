import type { LabelState } from "../types";
import type { Viewer } from "../view/viewer";
import { h, iconButton, setIcon, setText } from "./dom";
import { formatBytes, formatCount, formatDistance, formatSsim } from "./format";

const WEIGHTS = [0.25, 0.5, 1, 2, 4];

interface Row {
  readonly element: HTMLElement;
  update(state: LabelState): void;
}

/** The labels: colour, level, promised SSIM, size, distance, weight, and whether they are drawn. */
export class LabelTable {
  readonly element = h("ul", { class: "labels", "aria-label": "Labels" });
  readonly #rows = new Map<number, Row>();

  constructor(readonly viewer: Viewer) {}

  update(states: readonly LabelState[]): void {
    for (const state of states) {
      let row = this.#rows.get(state.label.id);
      if (!row) {
        row = makeRow(this.viewer, state);
        this.#rows.set(state.label.id, row);
        this.element.append(row.element);
      }
      row.update(state);
    }
    const sorted = [...states].sort((a, b) => b.label.levels.length && total(b) - total(a));
    const order = sorted.map(({ label }) => this.#rows.get(label.id)?.element);
    if (order.some((element, i) => element !== this.element.children[i])) {
      this.element.append(...order.filter((element) => element !== undefined));
    }
  }
}

const total = ({ label }: LabelState) => label.levels.reduce((sum, { count }) => sum + count, 0);

function makeRow(viewer: Viewer, { label }: LabelState): Row {
  const metres = viewer.manifest.frame.metersPerUnit;
  const bar = h("div", { class: "level", role: "img" }, h("i"), h("b"));
  const level = h("span", { class: "number" });
  const ssim = h("span", { class: "number ssim" });
  const facts = h("span", { class: "more" });
  const eye = iconButton("eye", "", () => viewer.setHidden(label.id, !viewer.isHidden(label.id)));
  const weight = weightSelect(viewer, label.id, label.title);
  const element = h(
    "li",
    {},
    h("span", { class: "swatch" }),
    h("span", { class: "name", title: label.name }, label.title),
    ssim,
    eye,
    bar,
    level,
    facts,
    weight,
  );
  element.style.setProperty("--label", label.color);
  let last = -1;

  function update(state: LabelState): void {
    const hidden = viewer.isHidden(label.id);
    const levels = state.label.levels.length;
    bar.style.setProperty("--shown", String(state.shown / levels));
    bar.style.setProperty("--wanted", String(state.wanted / levels));
    bar.setAttribute("aria-label", `level ${state.shown} of ${levels}, ${state.wanted} wanted`);
    setText(level, `${state.shown}/${levels}`);
    setText(ssim, formatSsim(state.promised));
    ssim.title = `promised SSIM ${formatSsim(state.promised)}, expected ${formatSsim(state.expected)}`;
    const place = state.visible ? formatDistance(state.distance * metres) : "out of sight";
    setText(facts, state.error ?? `${formatCount(state.count)} · ${formatBytes(state.bytes)} · ${place}`);
    element.classList.toggle("error", state.error !== null);
    element.classList.toggle("dim", hidden || !state.visible);
    element.classList.toggle("busy", state.loading);
    setEye(eye, label.title, hidden);
    if (last >= 0 && last !== state.shown) flash(element, state.shown > last);
    last = state.shown;
  }

  return { element, update };
}

function setEye(eye: HTMLButtonElement, title: string, hidden: boolean): void {
  const text = `${hidden ? "Show" : "Hide"} ${title}`;
  if (eye.title === text) return;
  eye.title = text;
  eye.setAttribute("aria-label", text);
  setIcon(eye, hidden ? "closed" : "eye");
}

function weightSelect(viewer: Viewer, label: number, title: string): HTMLSelectElement {
  const set = () => {
    const weights = new Map(viewer.settings.weights).set(label, Number(select.value));
    viewer.set({ weights });
  };
  const current = viewer.settings.weights.get(label) ?? 1;
  const steps = WEIGHTS.includes(current) ? WEIGHTS : [...WEIGHTS, current].sort((a, b) => a - b);
  const options = steps.map((w) => h("option", { value: w, selected: w === current }, `× ${w}`));
  const select = h(
    "select",
    { class: "weight", title: "Weight", "aria-label": `Weight of ${title}`, change: set },
    ...options,
  );
  return select;
}

/** A level change is seen for a moment. */
function flash(element: HTMLElement, up: boolean): void {
  element.classList.remove("up", "down");
  void element.offsetWidth; // so that the animation begins anew
  element.classList.add(up ? "up" : "down");
}
