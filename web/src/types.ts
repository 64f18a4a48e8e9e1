/** Types shared by the parts of the viewer. Geometry is in the bundle's frame unless noted. */

export type Vec3 = readonly [number, number, number];
export type Quat = readonly [number, number, number, number]; // x y z w
export type Box = readonly [number, number, number, number, number, number]; // min x y z, max x y z

/**
 * How a file holds splats. PLY is INRIA's, its y and z opposite to the bundle's; nothing is rounded in it. A
 * stream is one file for all levels of a label, of which each is a range (docs/formats.md).
 */
export const FORMATS = ["spz", "ply", "stream"] as const;
export type Format = (typeof FORMATS)[number];

/** One increment: the splats that a level adds to the level below, or replaces it by. */
export interface Level {
  readonly uri: string;
  readonly offset?: number; // of its first byte in a stream
  readonly format: Format;
  readonly refine?: "REPLACE"; // the level shows none of the increments below
  readonly bytes: number;
  readonly gpuBytes: number;
  readonly count: number;
  readonly sha256: string;
  readonly weight?: number; // of the second opacities where this is the newest level shown; without: there are none
}

/** K1 exp(-g1 |d - mu1|^a1) for d < beta, K2 exp(-g2 |d - mu2|^a2) from beta on (Eq. 3). */
export interface Curve {
  readonly params: readonly [number, number, number, number, number, number, number, number, number];
  readonly range: readonly [number, number]; // of the fitted distances
  readonly median: number; // used for an unknown distance
}

/** What quality is measured against: the full model from the same viewpoint, or photos. Both are SSIM. */
export const QUALITIES = ["fidelity", "ssim"] as const;
export type Quality = (typeof QUALITIES)[number];

/** Whether a bound holds at its confidence, or calibration views were too few for that. */
export const STATUSES = ["calibrated", "uncalibrated"] as const;
export type Status = (typeof STATUSES)[number];

/** A category's quality by level whatever the viewpoint, until the viewpoint models are there. */
export interface LabelQuality {
  readonly levels: readonly number[]; // 1-based levels with a prediction, ascending
  readonly status: Status;
  readonly confidence: number;
  readonly mean: readonly number[]; // over the model's viewpoints
  readonly bound: readonly number[] | null; // below the bounds of most of them; null: no promise
}

export interface Label {
  readonly id: number;
  readonly name: string; // in the taxonomy: grass-merged; in a scene in blocks: grass-merged@3
  readonly category?: string; // in a scene in blocks: grass-merged
  readonly block?: number; // in a scene in blocks: 3
  readonly title: string; // display name: grass
  readonly color: string; // #rrggbb
  readonly weight: number;
  readonly always: boolean; // shipped in full whatever the plan says
  readonly hidden?: boolean; // not shown to begin with
  readonly parent?: string; // of an instance: the name of its category
  readonly boxes: readonly Box[];
  readonly levels: readonly Level[]; // level k consists of increments up to k, from the newest REPLACE on
  readonly quality: Readonly<Partial<Record<Quality, LabelQuality>>>;
}

export interface Camera {
  readonly name: string;
  readonly split: "train" | "test" | "calibration";
  readonly position: Vec3;
  readonly quaternion: Quat; // camera to world; the camera looks along its -z, y is up
  readonly fovY: number; // radians
  readonly width: number; // px
  readonly height: number;
  readonly intrinsics: readonly [number, number, number, number]; // fx fy cx cy, px
}

export interface Manifest {
  readonly format: "sagesplat-bundle";
  readonly version: number;
  readonly generator: string;
  readonly name: string;
  readonly live: boolean; // training still runs: the manifest will change
  readonly frame: {
    readonly axes: "rub"; // the capture's world with y and z negated, as in SPZ
    readonly up: Vec3;
    readonly floor: number; // height of the ground along `up`
    readonly extent: number; // of the cameras
    readonly metersPerUnit: number;
    readonly scale: "given" | "guessed";
  };
  readonly shDegree: number;
  readonly antialiased: boolean;
  readonly background: Vec3; // 0..1
  /** Of the full scene: every label at its last level. */
  readonly totals: { readonly count: number; readonly bytes: number; readonly gpuBytes: number };
  readonly ladder?: string; // SHA-256 of the run's levels, which edits of labels are of
  readonly labels: readonly Label[];
  readonly promises: Readonly<Partial<Record<Quality, Reference>>>;
  readonly target: { readonly quality: Quality; readonly value: number }; // to begin with
  readonly pack?: Pack | null; // older bundles have none
  readonly cameras: readonly Camera[];
  readonly start: { readonly position: Vec3; readonly quaternion: Quat; readonly target: Vec3 };
  readonly licenses: readonly { readonly what: string; readonly license: string; readonly url?: string }[];
}

/** A file of the bundle. */
export interface Reference {
  readonly uri: string;
  readonly bytes: number;
  readonly sha256: string;
}

/** All increments concatenated in one file, best first: one stream is faster than many files. */
export interface Pack {
  readonly uri: string;
  readonly bytes: number; // sum over its increments
  readonly sha256: string;
  readonly order: readonly (readonly [number, number])[]; // index of the label, level (1-based)
}

/** The viewpoint models of all categories for one quality, as in src/sagesplat/viewer/promises.py. */
export interface Promises {
  readonly version: number;
  readonly quality: Quality;
  readonly extent: number;
  readonly views: readonly (readonly number[])[]; // x y z over the extent, direction: differences, 1/10000
  readonly labels: readonly LabelPromises[];
}

export interface LabelPromises {
  readonly id: number;
  readonly levels: readonly number[]; // 1-based levels with a prediction
  readonly status: Status;
  readonly confidence: number;
  readonly leastSupport: number; // below it there is no bound
  readonly discount: number; // of the mean where the support is 0; none at a known viewpoint
  readonly targets: readonly number[]; // ascending, 1/10000
  readonly thresholds: readonly number[]; // of the mean, by target
  readonly medianLogDistance: number; // for an unknown distance
  readonly lengths: Vec3; // of position, direction, log distance
  readonly curves: readonly Curve[]; // by level; empty: 0
  readonly offsets: readonly number[]; // by level
  readonly views: readonly number[]; // rows of the shared views: differences
  readonly logDistances: { readonly unit: number; readonly steps: readonly number[] }; // by own view: differences
  readonly values: {
    readonly units: readonly number[]; // by level
    readonly steps: readonly (readonly number[])[]; // by level and own view: differences along both
  };
  readonly shares: readonly number[]; // of the pixels, by shared view: differences, 1/10000
  readonly corrections: readonly number[]; // log of distance over that by boxes: differences, 1/200
}

/** A camera's pose and field of view. Position in units of its frame, `fovY` in radians. */
export interface Pose {
  readonly position: Vec3;
  readonly quaternion: Quat; // camera to frame; the camera looks along its -z, y is up
  readonly fovY?: number;
}

/** The viewer's position and view, in the bundle's frame. */
export interface Viewpoint {
  readonly position: Vec3;
  readonly direction: Vec3; // unit
  /** Six half spaces [nx, ny, nz, d] with n x + d >= 0 inside; empty: unlimited view. */
  readonly frustum: readonly (readonly [number, number, number, number])[];
}

export interface Budget {
  readonly bytes: number; // Infinity: none
  readonly gpuBytes: number;
  readonly count: number;
}

export interface Settings {
  readonly mode: "target" | "budget" | "full" | "base";
  readonly quality: Quality; // that the target is of
  readonly target: number;
  readonly budget: Budget; // kept in every mode
  readonly weights: ReadonlyMap<number, number>; // by label id
  readonly always?: ReadonlyMap<number, boolean>; // by label id, where it is not as in the manifest
  readonly cacheBytes: number; // of decoded increments that are not shown
}

/** Draws increments; independent of plans and networks. */
export interface Renderer {
  /**
   * Decodes an increment, which is drawn after `swap` shows it. Rejects for an invalid file.
   *
   * @param below - of a stream, the increments below it
   */
  decode(
    label: number,
    level: number,
    bytes: Uint8Array,
    format: Format,
    below?: readonly Uint8Array[],
  ): Promise<Handle>;
  /** Shows some increments and hides others in one tick; hidden ones stay drawn until the next sort is done. */
  swap(show: readonly Handle[], hide: readonly Handle[]): void;
  dispose(handle: Handle): void;
}

export interface Handle {
  readonly label: number;
  readonly level: number;
  readonly count: number;
}

/** "outside": far from all that was sampled or photographed, so no promise is given; "unknown": no model. */
export type Trust = Status | "outside" | "unknown";

export interface LabelState {
  readonly label: Label;
  readonly wanted: number; // level of the plan, 0 = none
  readonly shown: number; // drawn level
  readonly loading: boolean;
  readonly error: string | null;
  readonly visible: boolean; // in the frustum
  readonly distance: number; // NaN: unknown
  readonly promised: number; // the promise: lower confidence bound of quality at the shown level; NaN: none
  readonly expected: number; // mean quality at the shown level
  readonly trust: Trust; // in the promise
  readonly count: number; // splats shown
  readonly bytes: number;
  readonly gpuBytes: number;
}

export interface State {
  readonly labels: readonly LabelState[];
  readonly status: "loading" | "ok" | "infeasible" | "over budget";
  readonly bytesLoaded: number; // total downloaded
  readonly bytesShown: number;
  readonly gpuBytes: number; // of all decoded increments, shown or not
  readonly count: number; // shown
  readonly bandwidth: number; // bytes per second, measured; NaN: unknown
  readonly pending: number; // downloads
  readonly message: string | null; // for the user
}
