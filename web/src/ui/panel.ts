import { leastPromise } from "../core/describe";
import { qualitiesOf } from "../core/manifest";
import { linkTo } from "../embed";
import type { Quality, Settings } from "../types";
import { isTyping } from "../view/controls";
import { DEFAULT_TARGETS, type Viewer } from "../view/viewer";
import { h, iconButton, setText, textButton } from "./dom";
import { formatBytes, formatCount, formatLook, formatScreens, formatSsim, nameOf } from "./format";
import { LabelTable } from "./labels";
import { Looks } from "./looks";
import { photosOf } from "./toolbar";

const MODES: readonly (readonly [Settings["mode"], string])[] = [
  ["target", "Quality"],
  ["budget", "Budget"],
  ["full", "Full"],
];
const NARROW = "(max-width: 640px)";

/** The panel with mode, sliders, meters and categories; on a phone a sheet at the bottom. */
export class Panel {
  readonly element: HTMLElement;
  readonly #table: LabelTable;
  readonly #summary = h("span", { class: "summary" });
  readonly #meter = h("div", { class: "meter" }, h("i"));
  readonly #screens = h("p", { class: "screens" });
  readonly #facts = h("dl", { class: "facts" });
  readonly #sliders: Control[];
  readonly #modes: HTMLButtonElement[];

  constructor(readonly viewer: Viewer) {
    this.#table = new LabelTable(viewer);
    this.#modes = MODES.map(([mode, title]) =>
      h(
        "button",
        { type: "button", role: "radio", "data-mode": mode, click: () => setMode(viewer, mode) },
        title,
      ),
    );
    const target = targetSlider(viewer);
    const others = [...qualityChoice(viewer), ...budgetSliders(viewer)];
    this.#sliders = [target, ...others];
    const toggle = iconButton("chevron", "Panel (P)", () => this.toggle());
    this.element = h(
      "aside",
      { class: "panel card", "aria-label": "Levels of detail" },
      h("div", { class: "head" }, this.#summary, toggle),
      this.#meter,
      target.element, // there in a closed panel too: the one thing to set
      h(
        "div",
        { class: "body" },
        h(
          "div",
          {
            class: "modes",
            role: "radiogroup",
            "aria-label": "Planning mode",
            keydown: (event) => this.#step(event),
          },
          ...this.#modes,
        ),
        ...others.map(({ element }) => element),
        this.#screens,
        this.#facts,
        this.#table.element,
        sharing(viewer),
      ),
    );
    if (matchMedia(NARROW).matches) this.element.classList.add("closed");
    window.addEventListener("keydown", (event) => {
      if (event.key === "p" && !isTyping(event) && !event.ctrlKey && !event.metaKey) this.toggle();
    });
    this.#announce();
  }

  toggle(): void {
    this.element.classList.toggle("closed");
    this.#announce();
  }

  update(): void {
    const { state, settings, streamer, frameMs } = this.viewer;
    const { totals } = streamer.manifest; // grows while training runs
    const bytes = `${formatBytes(state.bytesShown)} of ${formatBytes(totals.bytes)}`;
    const drawn = state.labels.filter(({ visible, label }) => visible && !this.viewer.isHidden(label.id));
    const least = leastPromise(drawn);
    const quality = nameOf(settings.quality);
    const fetched = `${bytes} shown, ${formatBytes(state.bytesLoaded)} fetched`;
    const promise = `${quality} ≥ ${formatSsim(least)}`;
    setText(this.#summary, Number.isFinite(least) ? `${fetched} · ${promise}` : fetched);
    this.#summary.title = `Size of what is shown, of all that came for it, with what promises are made from, and the least ${quality} promised of what is in sight; 1 is no difference`;
    const { height } = this.viewer.stage.canvas;
    const photos = `${photosOf(this.viewer.manifest)}s`;
    setText(this.#screens, state.screens ? formatScreens(state.screens, height, photos) : "");
    this.#meter.style.setProperty("--value", String(state.bytesShown / Math.max(totals.bytes, 1)));
    for (const button of this.#modes) {
      const chosen = button.dataset.mode === settings.mode;
      button.setAttribute("aria-checked", String(chosen));
      button.tabIndex = chosen || settings.mode === "base" ? 0 : -1;
    }
    for (const slider of this.#sliders) slider.update(settings);
    this.#state([
      ["Splats", `${formatCount(state.count)} of ${formatCount(totals.count)}`],
      ["GPU", `${formatBytes(state.gpuBytes)} of ${formatBytes(totals.gpuBytes)}`],
      ["Network", `${formatBytes(state.bytesLoaded)}${rate(state.bandwidth)}`],
      ["Frame", Number.isNaN(frameMs) ? "idle" : `${frameMs.toFixed(frameMs < 10 ? 1 : 0)} ms`],
    ]);
    this.#table.update(state.labels);
  }

  /** Arrow keys change the mode, as in any radio group. */
  #step(event: Event): void {
    const by = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 }[(event as KeyboardEvent).key];
    if (!by) return;
    event.preventDefault();
    event.stopPropagation();
    const now = MODES.findIndex(([mode]) => mode === this.viewer.settings.mode);
    const at = (Math.max(now, 0) + by + MODES.length) % MODES.length;
    this.#modes[at]?.click();
    this.#modes[at]?.focus();
    this.update();
  }

  #state(facts: readonly (readonly [string, string])[]): void {
    if (!this.#facts.childElementCount) {
      this.#facts.append(...facts.map(([name]) => h("div", {}, h("dt", {}, name), h("dd"))));
    }
    const values = this.#facts.querySelectorAll("dd");
    for (const [i, [, value]] of facts.entries()) setText(values[i] as HTMLElement, value);
  }

  #announce(): void {
    const open = !this.element.classList.contains("closed");
    this.element.querySelector(".head button")?.setAttribute("aria-expanded", String(open));
    this.element.querySelector(".body")?.toggleAttribute("inert", !open);
  }
}

/** A budget without limits begins with what is loaded: to look at it costs nothing. */
function setMode(viewer: Viewer, mode: Settings["mode"]): void {
  const { settings, state } = viewer;
  const isOpen = Object.values(settings.budget).every((limit) => limit === Infinity);
  const budget = { ...settings.budget, bytes: state.bytesShown };
  viewer.set(mode === "budget" && isOpen && state.bytesShown > 0 ? { mode, budget } : { mode });
}

/** A link to this view, a picture of it, the whole screen. */
function sharing(viewer: Viewer): HTMLElement {
  const { canvas } = viewer.stage;
  const link = textButton("Copy link", "text", () => {
    const href = linkTo(location.href, viewer.pose(), viewer.settings);
    navigator.clipboard?.writeText(href).then(
      () => setText(link, "Link copied"),
      () => location.replace(href), // where a page may not write: the address is the link
    );
    setTimeout(() => setText(link, "Copy link"), 3000);
  });
  const picture = textButton("Save picture", "text", () => {
    const stop = viewer.onSample(() => {
      stop();
      canvas.toBlob((blob) => {
        if (!blob) return;
        const url = URL.createObjectURL(blob);
        h("a", { href: url, download: `${viewer.manifest.name}.png` }).click();
        setTimeout(() => URL.revokeObjectURL(url), 1000);
      });
    });
  });
  const whole = textButton("Full screen", "text", () => {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void document.documentElement.requestFullscreen();
  });
  const can = document.fullscreenEnabled ? [whole] : [];
  const free = textButton(
    "Move freely",
    "text",
    () => {
      viewer.bounds.isOn = !viewer.bounds.isOn;
      free.setAttribute("aria-pressed", String(!viewer.bounds.isOn));
    },
    {
      "aria-pressed": "false",
      title: "Go anywhere, also where nothing was photographed and through surfaces",
    },
  );
  return h("div", { class: "sharing" }, link, picture, ...can, free);
}

const rate = (bytes: number) => (Number.isFinite(bytes) ? ` · ${formatBytes(bytes)}/s` : "");

interface Control {
  readonly element: HTMLElement;
  update(settings: Settings): void;
}

function slider(
  name: string,
  modes: readonly Settings["mode"][],
  range: { min: number; max: number; step: number },
  read: (settings: Settings) => number,
  write: (value: number) => void,
  format: (settings: Settings) => string,
): Control {
  const input = h("input", {
    type: "range",
    ...range,
    "aria-label": name,
    input: () => write(input.valueAsNumber),
  });
  const value = h("output");
  const element = h("label", { class: "slider" }, h("span", {}, name), value, input);
  return {
    element,
    update: (settings) => {
      element.hidden = !modes.includes(settings.mode);
      if (document.activeElement !== input) input.valueAsNumber = read(settings);
      setText(value, format(settings));
      input.setAttribute("aria-valuetext", format(settings));
    },
  };
}

function targetSlider(viewer: Viewer): Control {
  const look = h("small", { class: "look" });
  const pictures = viewer.manifest.looks && new Looks(viewer, viewer.manifest.looks);
  const control = slider(
    "Keep quality at",
    ["target"],
    { min: 0.3, max: 0.99, step: 0.01 },
    ({ target }) => target,
    (target) => viewer.set({ target }),
    ({ target, quality }) => `${nameOf(quality)} ${formatSsim(target)}`,
  );
  control.element.append(look);
  if (pictures) {
    control.element.append(pictures.element);
    // nothing is fetched before somebody moves the slider
    for (const event of ["input", "pointerdown"] as const) {
      control.element.addEventListener(event, () => pictures.show(), { once: true });
    }
  }
  return {
    element: control.element,
    update: (settings) => {
      control.update(settings);
      setText(look, formatLook(settings.quality, settings.target));
      pictures?.update(settings);
    },
  };
}

const COMPARED: Readonly<Record<Quality, string>> = { fidelity: "the full scene", ssim: "the photos" };

/** What the target is measured against; none where the bundle leaves no choice. */
function qualityChoice(viewer: Viewer): Control[] {
  const known = qualitiesOf(viewer.manifest);
  if (known.length < 2) return [];
  const targets = { ...DEFAULT_TARGETS }; // that were last asked for
  const choose = () => {
    const { quality, target } = viewer.settings;
    targets[quality] = target;
    const chosen = known[select.selectedIndex] ?? quality;
    viewer.set({ quality: chosen, target: targets[chosen] });
  };
  const options = known.map((quality) => h("option", { value: quality }, COMPARED[quality]));
  const select = h("select", { "aria-label": "Compared with", change: choose }, ...options);
  const element = h("label", { class: "choice" }, h("span", {}, "Compared with"), select);
  return [
    {
      element,
      update: ({ mode, quality }) => {
        element.hidden = mode !== "target";
        if (document.activeElement !== select) select.value = quality;
      },
    },
  ];
}

/** One slider per unit, as a share of the full scene; the right end means no limit. */
function budgetSliders(viewer: Viewer): Control[] {
  const { totals } = viewer.manifest;
  const units = [
    ["Download", "bytes", formatBytes],
    ["GPU memory", "gpuBytes", formatBytes],
    ["Splats", "count", formatCount],
  ] as const;
  return units.map(([name, unit, format]) =>
    slider(
      name,
      ["budget"],
      { min: 1, max: 100, step: 1 },
      ({ budget }) => Math.min(100, (100 * budget[unit]) / totals[unit]),
      (share) => {
        const limit = share >= 100 ? Infinity : Math.round((totals[unit] * share) / 100);
        viewer.set({ budget: { ...viewer.settings.budget, [unit]: limit } });
      },
      ({ budget }) => format(budget[unit]),
    ),
  );
}
