import type { Camera, Settings, State } from "./types";
import type { Pose } from "./view/frame";

/** One drawn frame. */
export interface Sample {
  readonly time: number; // ms, of performance.now
  readonly frameMs: number; // since the frame before
  readonly drawn: number; // splats that the last sort put on the canvas
  readonly settled: boolean; // nothing waits to be sorted: the next frame would be the same
  readonly textures: number; // that three holds
  readonly presenting: boolean; // in a headset
  readonly cap: number; // splats allowed in a headset
  readonly state: State;
}

/** What a page that embeds the viewer may use: `window.sagesplat`. Poses are in the bundle's frame. */
export interface Embed {
  /** The manifest is read and everything else can be used; rejects with the message on the page. */
  readonly ready: Promise<void>;
  readonly version: string;
  readonly cameras: readonly Camera[];
  state(): State;
  settings(): Settings;
  set(partial: Partial<Settings>): void;
  pose(): Pose;
  setPose(pose: Pose): void;
  /** Goes to a photo's pose and lens, by name or index; RangeError where there is none. */
  goTo(photo: string | number): void;
  /** Calls back after every drawn frame, the next one soon, while the canvas can be read. Returns how to stop it. */
  onSample(callback: (sample: Sample) => void): () => void;
}

/** What the address says. */
export interface Options {
  readonly view: string | null;
  readonly target: number | null; // SSIM
  readonly budget: number | null; // MB
  readonly ui: boolean;
  readonly bundle: string; // folder, relative to the page
}

/** Reads `?view=NAME&target=0.8&budget=MB&ui=0&bundle=path/`, from the query and the fragment. Throws. */
export function parseOptions(search: string, hash: string): Options {
  const given = new URLSearchParams(`${search.replace(/^\?/, "")}&${hash.replace(/^#/, "")}`);
  return {
    view: given.get("view"),
    target: numeric(given, "target", 0, 1),
    budget: numeric(given, "budget", 0, 1e6),
    ui: given.get("ui") !== "0",
    bundle: bundlePath(given.get("bundle") ?? ""),
  };
}

function numeric(given: URLSearchParams, name: string, low: number, high: number): number | null {
  const text = given.get(name);
  if (text === null) return null;
  const value = Number(text);
  if (text.trim() === "" || !(value >= low && value <= high)) {
    throw new Error(`?${name}=${text} is not a number from ${low} to ${high}; correct the address.`);
  }
  return value;
}

/** A folder below the page's own, with a slash at its end. */
function bundlePath(path: string): string {
  let decoded = path;
  try {
    decoded = decodeURIComponent(path);
  } catch {
    decoded = "..";
  }
  if (/^[\w.-]+:|^\/|\\|[?#\0]/.test(decoded) || decoded.split("/").includes("..")) {
    throw new Error(
      `?bundle=${path} leaves this page's folder; give a folder below it, like ?bundle=garden/.`,
    );
  }
  return path === "" || path.endsWith("/") ? path : `${path}/`;
}
