import type { LabelState, Settings, State } from "../types";
import type { Viewer } from "../view/viewer";
import { h, setText } from "./dom";
import { EditorCard } from "./editor";
import { formatName, nameOf } from "./format";
import { helpDialog } from "./help";
import { Panel } from "./panel";
import { splitSlider } from "./split";
import { photosOf, toolbar } from "./toolbar";
import "./theme";
import { welcome } from "./welcome";

const REFRESH = 250; // ms between updates of the numbers

/** Builds the UI around the canvas, which is already in `app`. */
export function buildPage(app: HTMLElement, viewer: Viewer): void {
  const { manifest } = viewer;
  const panel = new Panel(viewer);
  const split = splitSlider(viewer);
  const help = helpDialog(photosOf(manifest));
  const bar = h("div", { class: "progress", role: "progressbar", "aria-label": "Loading" }, h("i"));
  const status = h("span", { class: "status", role: "status" });
  const title = h(
    "header",
    { class: "title card" },
    h("h1", { title: manifest.name }, formatName(manifest.name)),
    status,
  );
  const greeting = welcome(viewer.stage.canvas);
  if (greeting) title.append(greeting);
  const editor = new EditorCard(viewer.editor, viewer.token, () => update());
  const tools = toolbar(viewer, { split, help, editor, say });
  app.append(bar, title, split.element, tools.element, panel.element, editor.element, editor.cross, help);
  viewer.stage.canvas.setAttribute("role", "application");
  viewer.stage.canvas.setAttribute(
    "aria-label",
    `${formatName(manifest.name)}, a 3D scene. W A S D move, arrow keys turn, question mark for help.`,
  );

  let said: string | null = null;
  function say(message: string): void {
    said = message;
    setTimeout(() => {
      said = null;
      update();
    }, 6000);
    update();
  }

  function update(): void {
    const { state } = viewer;
    const cells = state.labels.flatMap((label) => label.cells);
    const wanted = cells.reduce((sum, cell) => sum + cell.wanted, 0);
    const shown = cells.reduce((sum, cell) => sum + Math.min(cell.shown, cell.wanted), 0);
    const done = wanted > 0 && shown >= wanted && !state.pending;
    bar.classList.toggle("done", done);
    bar.style.setProperty("--value", String(wanted ? shown / wanted : 0));
    bar.setAttribute("aria-valuenow", String(Math.round((100 * shown) / Math.max(wanted, 1))));
    status.classList.toggle("warn", Boolean(state.message || state.status === "over budget"));
    const isOffline = !navigator.onLine && (state.pending > 0 || state.message !== null);
    const offline = isOffline ? "You are offline; loading goes on with the connection" : null;
    setText(status, said ?? offline ?? state.message ?? sentence(viewer, done));
    status.title = state.message ?? "";
    panel.update();
    tools.update();
    split.update();
  }

  viewer.streamer.onChange(update);
  setInterval(update, REFRESH);
  update();
  if (viewer.token !== null) void editor.resume();
}

function sentence(viewer: Viewer, done: boolean): string {
  const { state, compare, stage } = viewer;
  if (compare.on && (compare.progress < 1 || !stage.isSplit))
    return `Loading the full scene, ${Math.floor(compare.progress * 100)} %`;
  if (state.status === "over budget") return "The lowest levels exceed the budget";
  if (state.status === "infeasible") return shortfall(state, viewer.settings);
  if (done && viewer.manifest.live) return "The run is still at work";
  if (done) return viewer.settings.mode === "target" ? outside(state) : "";
  return state.count ? "Refining…" : "Loading…";
}

/** Names the categories without a promise at this viewpoint. */
function outside(state: State): string {
  const known = state.labels.filter((l) => l.visible && l.trust !== "unknown");
  const short = known.filter((l) => l.trust === "outside");
  if (!short.length) return "";
  return short.length < known.length
    ? `No promise here for ${named(short)}`
    : "No promise here: too far from the viewpoints that were tried";
}

/** Names the categories that miss the target, or says that the budget is the limit. */
function shortfall(state: State, { mode, quality, target }: Settings): string {
  const short = state.labels.filter((l) => l.visible && l.wanted === 1 && l.promised < target);
  if (mode !== "target" || !short.length) return "Best quality within the budget";
  return `${named(short)} cannot reach ${nameOf(quality)} ${target.toFixed(2)}`;
}

function named(states: readonly LabelState[]): string {
  const names = [...new Set(states.map((l) => l.label.title))];
  return names.length > 2
    ? `${names.slice(0, 2).join(", ")} and ${names.length - 2} more`
    : names.join(" and ");
}
