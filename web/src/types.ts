/** Types shared by the parts of the viewer. Geometry is in the bundle's frame unless noted. */

export type Vec3 = readonly [number, number, number];
export type Quat = readonly [number, number, number, number]; // x y z w
export type Box = readonly [number, number, number, number, number, number]; // min x y z, max x y z

/** One increment: the splats that a level adds to the level below. */
export interface Level {
  readonly uri: string;
  readonly format: "spz";
  readonly bytes: number;
  readonly gpuBytes: number;
  readonly count: number;
  readonly sha256: string;
}

/** K1 exp(-g1 |d - mu1|^a1) for d < beta, K2 exp(-g2 |d - mu2|^a2) from beta on (Eq. 3). */
export interface Curve {
  readonly level: number; // 1-based
  readonly params: readonly [number, number, number, number, number, number, number, number, number];
  readonly range: readonly [number, number]; // of the fitted distances
  readonly median: number; // used for an unknown distance
  readonly rmse: number;
}

/** A category's quality model by distance alone. */
export interface LabelQuality {
  readonly status: "calibrated" | "pooled" | "uncalibrated";
  readonly confidence: number;
  readonly margin: readonly number[]; // by curve: offset to a lower confidence bound, SSIM
  readonly curves: readonly Curve[];
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
  readonly boxes: readonly Box[];
  readonly levels: readonly Level[]; // level k consists of increments 1..k
  readonly quality: LabelQuality | null;
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
  readonly totals: { readonly count: number; readonly bytes: number; readonly gpuBytes: number };
  readonly labels: readonly Label[];
  readonly promises: { readonly uri: string; readonly bytes: number; readonly sha256: string } | null;
  readonly pack?: Pack | null; // older bundles have none
  readonly cameras: readonly Camera[];
  readonly start: { readonly position: Vec3; readonly quaternion: Quat; readonly target: Vec3 };
  readonly licenses: readonly { readonly what: string; readonly license: string; readonly url?: string }[];
}

/** All increments concatenated in one file, best first: one stream is faster than many files. */
export interface Pack {
  readonly uri: string;
  readonly bytes: number; // sum over its increments
  readonly sha256: string;
  readonly order: readonly (readonly [number, number])[]; // index of the label, level (1-based)
}

/** The viewpoint models of all categories, as evaluated by src/sagesplat/adapt/viewpoint.py. */
export interface Promises {
  readonly version: number;
  readonly extent: number;
  readonly views: readonly (readonly [number, number, number, number, number, number])[]; // position, direction
  readonly labels: readonly {
    readonly id: number;
    readonly levels: readonly number[]; // 1-based levels with a bound
    readonly usual: number;
    readonly lengths: Vec3;
    readonly unseen: number;
    readonly noise: number;
    readonly factor: number;
    readonly confidence: number;
    readonly shift: number;
    readonly mixing: number;
    readonly amplitudes: readonly number[];
    readonly views: readonly number[]; // rows of the shared views
    readonly unseenViews: readonly number[]; // 0 or 1 for each of them
    readonly logDistances: readonly number[];
    readonly weights: readonly (readonly number[])[]; // [n][K]
    readonly corrections: readonly number[]; // log of distance over distance by boxes; 0: unknown
    readonly shares: readonly number[]; // pixel share in each shared view, 0..1
  }[];
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
  readonly target: number; // SSIM
  readonly budget: Budget; // kept in every mode
  readonly weights: ReadonlyMap<number, number>; // by label id
  readonly cacheBytes: number; // of decoded increments that are not shown
}

/** Draws increments; independent of plans and networks. */
export interface Renderer {
  /** Decodes an increment, which is drawn after `swap` shows it. Rejects for an invalid file. */
  decode(label: number, level: number, bytes: Uint8Array): Promise<Handle>;
  /** Shows some increments and hides others in one tick; hidden ones stay drawn until the next sort is done. */
  swap(show: readonly Handle[], hide: readonly Handle[]): void;
  dispose(handle: Handle): void;
}

export interface Handle {
  readonly label: number;
  readonly level: number;
  readonly count: number;
}

export interface LabelState {
  readonly label: Label;
  readonly wanted: number; // level of the plan, 0 = none
  readonly shown: number; // drawn level
  readonly loading: boolean;
  readonly error: string | null;
  readonly visible: boolean; // in the frustum
  readonly distance: number; // NaN: unknown
  readonly promised: number; // the promise: lower confidence bound of SSIM at the shown level; NaN: unknown
  readonly expected: number; // mean SSIM at the shown level
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
