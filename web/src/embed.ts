import { type Camera, type Pose, QUALITIES, type Quality, type Settings, type State } from "./types";

/** One drawn frame. */
export interface Sample {
  readonly time: number; // ms, of performance.now
  readonly frameMs: number; // since the previous frame
  readonly drawn: number; // splats drawn by the last sort
  readonly settled: boolean; // no sort is pending: the next frame would be the same
  readonly textures: number; // held by three
  readonly presenting: boolean; // in a headset
  readonly cap: number; // splats allowed in a headset
  readonly state: State;
}

/** What scripts can do with a viewer: of `createViewer`, and of `window.sagesplat`. Poses are in the bundle's frame. */
export interface Embed {
  readonly version: string; // of the sagesplat that made the bundle
  readonly cameras: readonly Camera[];
  state(): State;
  settings(): Settings;
  set(partial: Partial<Settings>): void;
  pose(): Pose;
  setPose(pose: Pose): void;
  /** Goes to a photo's pose and lens, by name or index; RangeError for an unknown photo. */
  goTo(photo: string | number): void;
  /** Requests a frame, and calls back after every drawn one, while the canvas is readable. Returns how to stop. */
  onSample(callback: (sample: Sample) => void): () => void;
  /** Stops it, frees its memory and takes it off the page. */
  destroy(): void;
}

/** The options in the page's address. */
export interface Options {
  readonly view: string | null;
  readonly pose: Pose | null;
  readonly quality: Quality | null; // that the target is of; null: the bundle's
  readonly target: number | null;
  readonly budget: number | null; // MB
  readonly ui: boolean;
  readonly bundle: string; // folder, relative to the page
  readonly edit: string | null; // what the server takes edits of labels with
}

/**
 * Reads `?view=NAME&pose=X,Y,Z,QX,QY,QZ,QW&quality=ssim&target=0.7&budget=MB&ui=0&bundle=path/`, from the query and
 * the fragment. Throws.
 */
export function parseOptions(search: string, hash: string): Options {
  const given = new URLSearchParams(`${search.replace(/^\?/, "")}&${hash.replace(/^#/, "")}`);
  return {
    view: given.get("view"),
    pose: poseOf(given.get("pose")),
    quality: qualityOf(given.get("quality")),
    target: numeric(given, "target", 0, 1),
    budget: numeric(given, "budget", 0, 1e6),
    ui: given.get("ui") !== "0",
    bundle: bundlePath(given.get("bundle") ?? ""),
    edit: given.get("edit"),
  };
}

function poseOf(text: string | null): Pose | null {
  if (text === null) return null;
  const numbers = text.split(",").map((part) => (part.trim() === "" ? Number.NaN : Number(part)));
  const [x = 0, y = 0, z = 0, qx = 0, qy = 0, qz = 0, qw = 0] = numbers;
  if (numbers.length !== 7 || !numbers.every(Number.isFinite) || !Math.hypot(qx, qy, qz, qw)) {
    throw new Error(`?pose=${text} is not seven numbers, of a place and a quaternion; correct the address.`);
  }
  return { position: [x, y, z], quaternion: [qx, qy, qz, qw] };
}

/** The address of a page that shows the same: its pose, and what is asked of it. */
export function linkTo(page: string, { position, quaternion }: Pose, settings: Settings): string {
  const url = new URL(page);
  const given = new URLSearchParams(`${url.search.slice(1)}&${url.hash.slice(1)}`);
  for (const name of ["view", "pose", "quality", "target", "budget", "edit"]) given.delete(name);
  given.set("pose", [...position, ...quaternion].map((value) => Number(value.toPrecision(6))).join());
  const { mode, quality, target, budget } = settings;
  if (mode === "target") {
    given.set("quality", quality);
    given.set("target", String(target));
  } else if (mode === "budget" && budget.bytes < Infinity) {
    given.set("budget", String(budget.bytes / 1e6));
  }
  url.search = given.toString().replaceAll("%2C", ",");
  url.hash = "";
  return url.href;
}

function qualityOf(text: string | null): Quality | null {
  const quality = QUALITIES.find((known) => known === text) ?? null;
  if (text !== null && !quality) {
    throw new Error(`?quality=${text} is not one of ${QUALITIES.join(", ")}; correct the address.`);
  }
  return quality;
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

/** A folder below the page's own, with a trailing slash. */
function bundlePath(path: string): string {
  const folder = path === "" || path.endsWith("/") ? path : `${path}/`;
  if (folder !== "" && !isBelow(folder)) {
    throw new Error(
      `?bundle=${path} leaves this page's folder; give a folder below it, like ?bundle=garden/.`,
    );
  }
  return folder;
}

/** The URL of a bundle's folder, below that of the page; throws for any other. */
export function bundleUrl(folder: string, page: string): URL {
  const own = new URL("./", page.replace(/[?#].*/, ""));
  const url = new URL(`./${folder}`, own);
  if (url.origin !== own.origin || !url.pathname.startsWith(own.pathname)) {
    throw new Error(`?bundle=${folder} leaves this page's folder; correct the address.`);
  }
  return url;
}

/**
 * Whether a relative address stays below the folder that it is relative to, as browsers resolve it: they take
 * backslashes for slashes and "%2e" for dots, and drop tabs and line breaks. Servers may decode once more.
 */
function isBelow(folder: string): boolean {
  for (let text = folder, times = 0; times < 5; times += 1) {
    if (/[\p{Cc}\\?#]/u.test(text) || !resolvesBelow(text)) return false;
    let decoded: string;
    try {
      decoded = decodeURIComponent(text);
    } catch {
      return false;
    }
    if (decoded === text) return true;
    text = decoded;
  }
  return false;
}

function resolvesBelow(text: string): boolean {
  const page = new URL("https://page.invalid/a/b/");
  const url = URL.canParse(text, page) ? new URL(text, page) : null;
  const below = url?.origin === page.origin && url.pathname.startsWith(page.pathname);
  // "a/../b" would do as well, but not where a link or a server takes it otherwise
  return below && !text.split("/").includes("..") && !/^[\w.+-]*:|^\//.test(text);
}
