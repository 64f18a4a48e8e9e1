import type { LabelState, Trust } from "../types";
import type { Viewer } from "../view/viewer";
import { h, iconButton, setIcon, setText } from "./dom";
import { formatBytes, formatCount, formatDistance, formatShare, formatSsim, nameOf } from "./format";
import { grouped, instances, summary } from "./groups";

const WEIGHTS = [0.25, 0.5, 1, 2, 4];
const MEANING: Readonly<Record<Trust, string>> = {
  calibrated: "a lower bound that holds in 95 of 100 decisions",
  uncalibrated: "too few viewpoints to calibrate it: a careful guess, not proven",
  outside: "no promise here: too far from the viewpoints that were tried, so it is shown in full",
  unknown: "no promise: nothing is known of its quality",
};
const REMARK: Readonly<Record<Trust, string>> = {
  calibrated: "",
  uncalibrated: "uncalibrated · ",
  outside: "no promise here · ",
  unknown: "",
};

interface Row {
  readonly element: HTMLElement;
  update(states: readonly LabelState[]): void;
}

/** The list of categories: colour, share of its splats, promised quality, size, distance, weight, and visibility. */
export class LabelTable {
  readonly element = h("ul", { class: "labels", "aria-label": "Labels" });
  readonly #rows = new Map<string, Row>();

  constructor(readonly viewer: Viewer) {}

  update(states: readonly LabelState[]): void {
    const groups = grouped(states);
    for (const { key, title, states: labels } of groups) {
      let row = this.#rows.get(key);
      if (!row) {
        row = labelRow(this.viewer, labels, title);
        this.#rows.set(key, row);
        this.element.append(row.element);
      }
      row.update(labels);
    }
    const order = groups.map(({ key }) => this.#rows.get(key)?.element);
    if (order.some((element, i) => element !== this.element.children[i])) {
      this.element.append(...order.filter((element) => element !== undefined));
    }
  }
}

/** The row of a category, which can be expanded to its instances. */
function labelRow(viewer: Viewer, states: readonly LabelState[], title: string): Row {
  const label = states[0]?.label;
  const isFamily = instances(states).length > 1;
  let latest = states;
  const ids = () => latest.map((state) => state.label.id);
  const isHidden = () => ids().every((id) => viewer.isHidden(id));
  const eye = iconButton("eye", "", () => viewer.setHidden(ids(), !isHidden()));
  const facts = factsRow(viewer, title, label?.name ?? "", label?.color ?? "");
  facts.element.append(eye, weightSelect(viewer, ids, title));
  const parts = isFamily ? instanceList(viewer, facts.element, title) : null;
  return {
    element: facts.element,
    update: (now) => {
      latest = now;
      facts.update(now);
      setEye(eye, title, isHidden());
      parts?.update(now);
    },
  };
}

/** The expandable list of a category's instances. */
function instanceList(viewer: Viewer, parent: HTMLElement, title: string): Pick<Row, "update"> {
  const rows = new Map<string, Row>();
  const list = h("ul", { class: "parts", "aria-label": `${title} by instance`, hidden: true });
  const more = h("button", { type: "button", class: "instances", "aria-expanded": "false" });
  let latest: readonly LabelState[] = [];
  more.addEventListener("click", () => {
    list.hidden = !list.hidden;
    more.setAttribute("aria-expanded", String(!list.hidden));
    update(latest);
  });
  parent.classList.add("category");
  parent.append(more, list);

  function update(states: readonly LabelState[]): void {
    latest = states;
    const parts = instances(states);
    setText(more, parts.length === 1 ? "1 instance" : `${parts.length} instances`);
    if (list.hidden) return;
    for (const { key, title: own, states: labels } of parts) {
      let row = rows.get(key);
      if (!row) {
        row = labelRow(viewer, labels, own);
        rows.set(key, row);
        list.append(row.element);
      }
      row.update(labels);
    }
  }
  return { update };
}

/** Colour, name, share of the splats, quality, size and distance. */
function factsRow(viewer: Viewer, title: string, name: string, color: string): Row {
  const metres = viewer.manifest.frame.metersPerUnit;
  const bar = h("div", { class: "level", role: "img" }, h("i"), h("b"));
  const share = h("span", { class: "number" });
  const quality = h("span", { class: "number ssim" });
  const facts = h("span", { class: "more" });
  const element = h(
    "li",
    {},
    h("span", { class: "swatch" }),
    h("span", { class: "name", title: name }, title),
    quality,
    bar,
    share,
    facts,
  );
  element.style.setProperty("--label", color);
  let last = Number.NaN;

  function update(states: readonly LabelState[]): void {
    const now = summary(states);
    bar.style.setProperty("--shown", String(now.shown));
    bar.style.setProperty("--wanted", String(now.wanted));
    bar.setAttribute(
      "aria-label",
      `${formatShare(now.shown)} of its splats, ${formatShare(now.wanted)} planned`,
    );
    setText(share, formatShare(now.shown));
    share.title = `Drawn of its splats ${now.visible ? "in sight" : "in the whole scene"}`;
    const name = nameOf(viewer.settings.quality);
    setText(quality, formatSsim(now.promised));
    const meaning = now.missing ? "no promise: not all of it is drawn" : MEANING[now.trust];
    quality.title = `promised ${name} ${formatSsim(now.promised)}, expected ${formatSsim(now.expected)}; ${meaning}`;
    const place = now.visible ? formatDistance(now.distance * metres) : "out of sight";
    const remark = now.visible ? REMARK[now.trust] : "";
    const size = `${formatCount(now.count)} · ${formatBytes(now.bytes)}`;
    setText(facts, now.error ?? `${remark}${size} · ${place}`);
    element.classList.toggle("error", now.error !== null);
    element.classList.toggle("dim", !now.visible || states.every(({ label }) => viewer.isHidden(label.id)));
    element.classList.toggle("busy", now.loading);
    if (states.length === 1 && last !== now.shown && !Number.isNaN(last)) flash(element, now.shown > last);
    last = now.shown;
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

/** The weight of all labels of a row; if they differ, none is selected. */
function weightSelect(viewer: Viewer, ids: () => number[], title: string): HTMLSelectElement {
  const set = () => {
    const weights = new Map(viewer.settings.weights);
    for (const id of ids()) weights.set(id, Number(select.value));
    viewer.set({ weights });
  };
  const given = new Set(ids().map((id) => viewer.settings.weights.get(id) ?? 1));
  const steps = [...new Set([...WEIGHTS, ...given])].sort((a, b) => a - b);
  const options = steps.map((w) =>
    h("option", { value: w, selected: given.size === 1 && given.has(w) }, `× ${w}`),
  );
  const select = h(
    "select",
    { class: "weight", title: "Weight", "aria-label": `Weight of ${title}`, change: set },
    ...options,
  );
  if (given.size > 1) select.selectedIndex = -1;
  return select;
}

/** Highlights a change of level briefly. */
function flash(element: HTMLElement, up: boolean): void {
  element.classList.remove("up", "down");
  void element.offsetWidth; // forces a layout, which restarts the animation
  element.classList.add(up ? "up" : "down");
}
