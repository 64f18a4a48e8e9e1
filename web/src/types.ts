/** Types shared by the parts of the viewer. Geometry is in the bundle's frame unless noted. */

import type * as documents from "./documents";
import type { Format, Quality, Status } from "./documents";

export type { Format, Quality, Status };
export const QUALITIES: readonly Quality[] = ["fidelity", "ssim"];

/** A type of plain data whose fields and items do not change. */
type Immutable<T> = { readonly [K in keyof T]: Immutable<T[K]> };

/** The manifest as `parseManifest` returns it. */
export type Manifest = Omit<Immutable<documents.Manifest>, "labels" | "promises" | "totals"> & {
  readonly labels: readonly Label[];
  readonly promises: { readonly [quality in Quality]?: Keyed<documents.Reference> };
  readonly totals: Readonly<Record<"count" | "bytes" | "gpuBytes", number>>;
};
export type Label = Omit<Immutable<documents.Label>, "cells" | "palette"> & {
  readonly cells: readonly Cell[];
  readonly palette?: Keyed<documents.Palette>;
};
export type Cell = Omit<Immutable<documents.Cell>, "levels"> & { readonly levels: readonly Level[] };
/** A file or range with a name that no other has. */
type Keyed<T> = Immutable<T> & { readonly key: string };
/** The increment that a level adds to the level below, or replaces it by. */
export interface Level {
  readonly uri: string;
  readonly format: Format;
  readonly offset?: number; // of a range
  readonly bytes: number;
  readonly gpuBytes: number;
  readonly count: number; // Gaussians
  readonly key: string;
  readonly sha256: string; // its first digits
  readonly refine?: "REPLACE";
  readonly weight?: number; // of second opacities
}
export type LabelQuality = Immutable<documents.LabelQuality>;
export type Camera = Immutable<documents.Camera>;
export type Pack = Immutable<documents.Pack>;
export type Promises = Immutable<documents.Promises>;
export type LabelPromises = Immutable<documents.LabelPromises>;
export type CellPromises = Immutable<documents.CellPromises>;
export type Curve = Immutable<documents.Curve>;
export type Vec3 = Immutable<documents.Vec3>;
export type Quat = Immutable<documents.Quaternion>;
export type Box = Immutable<documents.Box>;

/** Half width and half height of a picture at distance 1. */
export type Lens = readonly [number, number];

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
  readonly lens: Lens;
  /** Focal length of what is drawn, in its pixels; absent: that of the photos. */
  readonly focal?: number;
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
  readonly aroundBytes: number; // beside the plan, for cells out of sight that a turn of the head shows
}

/** Draws increments; independent of plans and networks. */
export interface Renderer {
  /**
   * Decodes an increment of a cell, which is drawn after `swap` shows it. Rejects for an invalid file.
   *
   * @param below - of a stream, the increments below it
   * @param palette - of its file, if it needs one
   */
  decode(
    label: number,
    cell: number,
    level: number,
    bytes: Uint8Array,
    format: Format,
    below?: readonly Uint8Array[],
    palette?: { readonly key: string; readonly bytes: Uint8Array },
  ): Promise<Handle>;
  /** Shows some increments and hides others in one tick; hidden ones stay drawn until the next sort is done. */
  swap(show: readonly Handle[], hide: readonly Handle[]): void;
  dispose(handle: Handle): void;
}

export interface Handle {
  readonly label: number;
  readonly cell: number;
  readonly level: number;
  readonly count: number;
}

/** "outside": far from all that was sampled or photographed, so no promise is given; "unknown": no model. */
export type Trust = Status | "outside" | "unknown";

export interface CellState {
  readonly cell: Cell;
  readonly wanted: number; // level of the plan, 0 = none
  readonly shown: number; // drawn level
  readonly visible: boolean; // in the frustum
}

export interface LabelState {
  readonly label: Label;
  readonly cells: readonly CellState[];
  readonly splats: number; // in full, of its cells in sight, or else of all
  readonly wanted: number; // share of these that is planned
  readonly shown: number; // the same of those drawn
  readonly loading: boolean;
  readonly error: string | null;
  readonly visible: boolean; // any cell
  readonly distance: number; // of the nearest cell; NaN: out of sight
  readonly promised: number; // quality of what is drawn that 95 of 100 such views have, at most the target; NaN: none
  readonly expected: number; // mean quality of what is drawn of it in sight
  readonly trust: Trust; // in the promise
  readonly count: number; // splats shown, as bytes and GPU bytes of all cells
  readonly bytes: number;
  readonly gpuBytes: number;
}

/** What promises are for: the viewer's focal length in pixels over the photos'. */
export interface Screens {
  readonly least: number;
  readonly most: number; // a larger one is promised what its picture has, averaged down to this
  readonly here: number; // of the present viewpoint
  readonly fov?: number | undefined; // of the widest lens, degrees of the shorter side; none: the photos'
}

export interface State {
  readonly labels: readonly LabelState[];
  readonly status: "loading" | "ok" | "infeasible" | "over budget";
  readonly bytesLoaded: number; // total downloaded
  readonly bytesShown: number;
  readonly gpuBytes: number; // of what the GPU has: all that is drawn, and what is kept above it
  readonly count: number; // shown
  readonly bandwidth: number; // bytes per second, measured; NaN: unknown
  readonly pending: number; // downloads
  readonly screens: Screens | null; // that promises are for; null: not known yet
  readonly message: string | null; // for the user
}
