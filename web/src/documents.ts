/** The documents of a bundle. Generated from src/sagesplat/viewer/manifest.schema.json by `npm run build`. */

export type Vec3 = [number, number, number];
export type Whole = number;
/** A SHA-256 in hexadecimal. */
export type Sha256 = string;
/** A path below the bundle's folder. */
export type Path = string;
/** A SHA-256 in hexadecimal, or its first digits. */
export type Digits = string;
/** Smallest x y z, largest x y z. */
export type Box = [number, number, number, number, number, number];
/** A list of bytes in base64. */
export type Bytes = string;
/** A range of a coded stream, of which a cell has one, and a file those of a label; or SPZ version 3; or a binary PLY in INRIA's layout, its y and z opposite to the bundle's. */
export type Format = "stream" | "spz" | "ply";
/** Whether a bound holds at its confidence, or calibration views were too few for that. */
export type Status = "calibrated" | "uncalibrated";
/** What quality is measured against: the full model from the same viewpoint (fidelity), or photos (ssim). Both are SSIM. */
export type Quality = "fidelity" | "ssim";
/** x y z w, camera to world; the camera looks along its -z, y is up. */
export type Quaternion = [number, number, number, number];
/** Whole steps of a unit. */
export type Steps = number[];
export type Unit = number;

/** manifest.json of a sagesplat bundle: a labelled splat scene in nested levels of detail. Lengths in the capture's units, axes right, up, back. `$defs.promises` is the format of promises-*.json. */
export interface Manifest {
  format: "sagesplat-bundle";
  version: 1;
  generator: string;
  name: string;
  /** Training still runs: the manifest will change. */
  live: boolean;
  frame: {
    /** COLMAP's world with y and z negated, as in SPZ. */
    axes: "rub";
    up: Vec3;
    /** Height of the ground along up. */
    floor: number;
    /** 1.1 times the largest distance of a training camera from their mean. */
    extent: number;
    metersPerUnit: number;
    scale: "given" | "guessed";
  };
  shDegree: number;
  antialiased: boolean;
  background: [number, number, number];
  /** Of the full scene: every label at its last level. */
  totals: {
    count: Whole;
    bytes: Whole;
  };
  /** Of a Gaussian in the textures that the viewer draws from, at most while a scene grows. */
  gpuBytes: number;
  ladder?: Sha256;
  /** What fidelities look like: a picture with the same part of a view for each, side by side, equally wide; 1 is the full scene. */
  looks?: {
    uri: "looks.jpg";
    /** Ascending. */
    targets: number[];
  };
  labels: Label[];
  /** Viewpoint models by quality: against the full model (fidelity), against photos (ssim). */
  promises: {
    fidelity?: Reference;
    ssim?: Reference;
  };
  /** What a viewer begins with. */
  target: {
    quality: Quality;
    value: number;
  };
  pack: null | Pack;
  cameras: Camera[];
  start: {
    position: Vec3;
    quaternion: Quaternion;
    target: Vec3;
  };
  licenses: {
    what: string;
    license: string;
    /** Below the bundle. */
    url?: string;
  }[];
}
export interface Label {
  /** -1: unlabelled. */
  id: number;
  /** Name in the taxonomy. */
  name: string;
  /** Of an instance: the name of its category, such as chair for chair 1. */
  parent?: string;
  /** Display name. */
  title: string;
  /** A colour as #rrggbb. */
  color: string;
  weight: number;
  /** Always shipped in full, independent of the plan. */
  always: boolean;
  /** Not shown to begin with. */
  hidden?: true;
  palette?: Palette;
  cells: Cell[];
  quality: {
    fidelity?: LabelQuality;
    ssim?: LabelQuality;
  };
}
/** What the streams of a label's highest levels, from the last that replaces on, take their harmonics from: the first bytes of their file. */
export interface Palette {
  uri: Path;
  offset: 0;
  bytes: Whole;
  sha256: Digits;
}
/** A compact part of a label, with levels of its own. */
export interface Cell {
  /** No other cell of the bundle has it. */
  id: number;
  bounds: Box;
  points: Bytes;
  /** That all points stand for, world units squared. */
  area: number;
  /** By how far Gaussians lie around their point, world units. */
  radius: number;
  levels: Levels[];
}
/** The increments that consecutive levels of a cell add to the level below: a level that is a file, or those of a coded stream, which are ranges that touch. */
export interface Levels {
  uri: Path;
  format: Format;
  /** The first of these levels shows none of the increments below it. Without this it adds to them. */
  refine?: "REPLACE";
  offset?: Whole;
  /** A text of the first digits of each level's SHA-256 in hexadecimal, equally many. */
  sha256: string;
  /** By level, weight of the second opacities of all Gaussians of the cell where it is the newest. Without them each has one opacity. */
  weights?: number[];
  bytes: number[];
  /** Gaussians. */
  counts: number[];
}
/** Quality by level whatever the viewpoint, until the viewpoint models are there. */
export interface LabelQuality {
  /** Levels that have a prediction, ascending: all cells at that level, or at their last one. */
  levels: number[];
  status: Status;
  confidence: number;
  /** Expected quality, mean over the model's viewpoints. */
  mean: number[];
  /** Below the lower confidence bound of as many of these viewpoints as the confidence says; null: no promise. */
  bound: null | number[];
}
/** A file of the bundle. */
export interface Reference {
  uri: Path;
  bytes: number;
  sha256: Sha256;
}
/** Increments that the first view needs, concatenated in one file: the first levels of all cells, then those of larger gain. Few ranges of it are faster than many of other files. */
export interface Pack {
  uri: Path;
  /** Sum over the increments in it. */
  bytes: number;
  sha256: Sha256;
  /** Id of a cell, level (1-based). */
  order: [Whole, Whole][];
}
export interface Camera {
  name: string;
  split: "train" | "test" | "calibration";
  position: Vec3;
  quaternion: Quaternion;
  /** Radians. */
  fovY: number;
  width: number;
  height: number;
  /** fx fy cx cy, pixels. */
  intrinsics: [number, number, number, number];
}
/** promises-*.json: the viewpoint models of all labels for one quality. Its lists of steps and rows are written as their lengths, and their numbers in `numbers` (docs/formats.md). */
export interface Promises {
  quality: Quality;
  extent: number;
  /** Focal length of the photos, pixels; a viewer's over it is its screen. */
  focal: number;
  /** Screens that promises are for, from and to; others count as the nearer end. */
  screens: [number, number];
  /** Of fidelity: of the ladder that cells' levels are of. */
  levels?: number;
  /** Of fidelity: the widest lens that was tried, degrees of the picture's shorter side. */
  fov?: number;
  /** By axis (x y z over the extent, direction, log screen, log field) and view, in 1/10000. */
  views: [Steps, Steps, Steps, Steps, Steps, Steps, Steps, Steps];
  /** Photos that thresholds rise away from, as views without a screen. None: the views of a label. */
  photos: [Steps, Steps, Steps, Steps, Steps, Steps];
  labels: LabelPromises[];
}
/** The viewpoint models of a label's cells, and its calibration. */
export interface LabelPromises {
  id: number;
  status: Status;
  confidence: number;
  /** Below it there is no bound. */
  leastSupport: number;
  /** Length scales of position, direction, log screen and log field, log distance. */
  lengths: [number, number, number, number];
  targets: Steps;
  thresholds: Steps;
  slopes: Steps;
  cells: CellPromises[];
}
/** The viewpoint model of a cell; for SSIM against photos that of the label as a whole. */
export interface CellPromises {
  /** -1: all cells of the label. */
  id: number;
  /** Of a cell: by level, which of the ladder's it is. */
  ladder?: number[];
  /** Of a label as a whole: 1-based levels with a prediction. */
  levels?: number[];
  /** For an unknown distance. */
  medianLogDistance: number;
  offsets: Steps;
  /** Of the shared views that the model is fitted on. None: the mean is the offsets. */
  rows: Whole[];
  logUnit: Unit;
  logDistances: Steps;
  /** Of a cell: by cosine over the ladder and own view, in 3/100 of what is missing at a level. */
  terms?: Steps[];
  /** Of a label as a whole: of its values, by level. */
  units?: Unit[];
  /** Of a label as a whole: by level and own view, differences to the level below. */
  values?: Steps[];
  factors?: Steps;
  /** By level; none: 0. Of a label as a whole. */
  curves?: Curve[];
  shares?: Steps;
  corrections?: Steps;
}
/** K1 exp(-g1 |d - mu1|^a1) for d < beta, K2 exp(-g2 |d - mu2|^a2) from beta on (Eq. 3). */
export interface Curve {
  level: number;
  /** K1 g1 mu1 a1 K2 g2 mu2 a2 beta. */
  params: [number, number, number, number, number, number, number, number, number];
  /** Of the fitted distances. */
  range: [number, number];
  /** Used for an unknown distance. */
  median: number;
}
