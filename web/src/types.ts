/** What the parts of the viewer say to each other. Everything is in the bundle's frame unless said otherwise. */

export type Vec3 = readonly [number, number, number];
export type Quat = readonly [number, number, number, number]; // x y z w
export type Box = readonly [number, number, number, number, number, number]; // min x y z, max x y z

/** One increment: what a level adds to the one below it. */
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
  readonly median: number; // where the distance is unknown
  readonly rmse: number;
}

/** What is known of a category's SSIM from its distance alone. */
export interface LabelQuality {
  readonly status: "calibrated" | "pooled" | "uncalibrated";
  readonly confidence: number;
  readonly margin: readonly number[]; // by curve: from what the curve says to what can be promised, SSIM
  readonly curves: readonly Curve[];
}

export interface Label {
  readonly id: number;
  readonly name: string; // in the taxonomy: grass-merged; of a part of a scene in blocks: grass-merged@3
  readonly category?: string; // of a part: grass-merged
  readonly block?: number; // of a part: 3
  readonly title: string; // for people: grass
  readonly color: string; // #rrggbb
  readonly weight: number;
  readonly always: boolean; // shipped in full whatever the plan says
  readonly boxes: readonly Box[];
  readonly levels: readonly Level[]; // level k is what increments 1..k show together
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
  readonly live: boolean; // training goes on: the manifest will change
  readonly frame: {
    readonly axes: "rub"; // the capture's world with y and z negated, as SPZ has it
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

/** Increments in one file, one after the other, best first: as a stream it is quicker than many files. */
export interface Pack {
  readonly uri: string;
  readonly bytes: number; // the sum of those of its increments
  readonly sha256: string;
  readonly order: readonly (readonly [number, number])[]; // index of the label, level (1-based)
}

/** The viewpoint models of all categories: src/sagesplat/adapt/promise.py says how they are evaluated. */
export interface Promises {
  readonly version: number;
  readonly extent: number;
  readonly views: readonly (readonly [number, number, number, number, number, number])[]; // position, direction
  readonly labels: readonly {
    readonly id: number;
    readonly levels: readonly number[]; // 1-based, that have a promise
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
    readonly corrections: readonly number[]; // log of each one's distance over what the boxes tell; 0: unknown
    readonly shares: readonly number[]; // of the pixels of each shared view, 0..1
  }[];
}

/** Where the viewer stands, in the bundle's frame. */
export interface Viewpoint {
  readonly position: Vec3;
  readonly direction: Vec3; // unit
  /** Six half spaces [nx, ny, nz, d] with n x + d >= 0 inside; empty: look everywhere. */
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

/** Draws increments. Nothing of it knows of plans or networks. */
export interface Renderer {
  /** Decodes; the handle is drawn only once shown. Rejects for a file that cannot be decoded. */
  decode(label: number, level: number, bytes: Uint8Array): Promise<Handle>;
  /** In one tick: show some, hide others; what is hidden stays drawn until the next sort has landed. */
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
  readonly shown: number; // level drawn now
  readonly loading: boolean;
  readonly error: string | null;
  readonly visible: boolean; // in the frustum
  readonly distance: number; // NaN: unknown
  readonly promised: number; // SSIM bound of the shown level; NaN: no promise
  readonly expected: number; // SSIM mean of the shown level
  readonly count: number; // of what is shown
  readonly bytes: number;
  readonly gpuBytes: number;
}

export interface State {
  readonly labels: readonly LabelState[];
  readonly status: "loading" | "ok" | "infeasible" | "over budget";
  readonly bytesLoaded: number; // over the network, in all
  readonly bytesShown: number;
  readonly gpuBytes: number; // of all decoded increments, shown or not
  readonly count: number; // shown
  readonly bandwidth: number; // bytes a second, measured; NaN: not yet
  readonly pending: number; // downloads
  readonly message: string | null; // something that the user should know
}
