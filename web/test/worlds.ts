/** Small bundles made up for tests. */

import { rotate } from "../src/core/distance";
import type * as documents from "../src/documents";
import type {
  Cell,
  CellPromises,
  Label,
  LabelPromises,
  LabelQuality,
  Lens,
  Level,
  Manifest,
  Pack,
  Promises,
  Quat,
  Settings,
  Vec3,
  Viewpoint,
} from "../src/types";
import { fnv, type Network, seeded } from "./simulate";

export const BASE = new URL("https://example.org/");
export const PROMISES = "promises-1.json";
export const FOCAL = 800; // px, of the photos
const GPU_BYTES = 56; // of a Gaussian
export const NO_BUDGET = { bytes: Infinity, gpuBytes: Infinity, count: Infinity };
export const DEFAULTS: Settings = {
  mode: "target",
  quality: "fidelity",
  target: 0.8,
  budget: NO_BUDGET,
  weights: new Map(),
  cacheBytes: 1e9,
  aroundBytes: 0,
};
/** Looks along -z from a place, without a frustum. */
export const at = (x: number, y = 0, z = 0): Viewpoint => ({
  position: [x, y, z],
  direction: [0, 0, -1],
  frustum: [],
  lens: [0.8, 0.5],
});
/** Sees what is right of x = 0. */
export const rightOf = (view: Viewpoint): Viewpoint => ({ ...view, frustum: [[1, 0, 0, 0]] });

/** Half width and half height at distance 1. */
export const lensOf = (fovY: number, aspect: number): Lens => [
  aspect * Math.tan(fovY / 2),
  Math.tan(fovY / 2),
];

/** Half spaces of a camera's frustum: left, right, bottom, top, front; the near plane is at the camera. */
export function frustumOf(
  position: Vec3,
  quaternion: Quat,
  fovY: number,
  aspect: number,
): Viewpoint["frustum"] {
  const high = Math.tan(fovY / 2);
  const wide = high * aspect;
  const normals: Vec3[] = [
    [1, 0, -wide],
    [-1, 0, -wide],
    [0, 1, -high],
    [0, -1, -high],
    [0, 0, -1],
  ];
  return normals.map((normal) => {
    const [x, y, z] = rotate(quaternion, normal);
    const length = Math.hypot(x, y, z);
    const n = [x / length, y / length, z / length] as const;
    return [...n, -(n[0] * position[0] + n[1] * position[1] + n[2] * position[2])] as const;
  });
}

export interface Options {
  readonly labels?: number;
  readonly cells?: number; // of each label
  readonly levels?: number;
  readonly bytes?: number; // of an increment, about
  readonly seed?: number;
  readonly live?: boolean;
  readonly promises?: boolean;
  readonly pack?: boolean;
  readonly replaces?: readonly number[]; // levels that replace those below
  readonly streams?: boolean; // each label is one file, the levels of its cells ranges of it
  readonly palette?: number; // bytes of each label's palette, at the start of its file
}

/** A bundle whose files are on a network; label i stands at x = 4 i - 8, its cells side by side. */
export function bundle(network: Network, options: Options = {}): Manifest {
  const {
    labels = 4,
    cells = 1,
    levels = 5,
    bytes = 20_000,
    seed = 1,
    live = false,
    promises = true,
  } = options;
  const { pack = false, replaces = [], streams = false, palette = 0 } = options;
  const random = seeded(seed);
  const made = Array.from({ length: labels }, (_, id) => {
    const files = Array.from({ length: cells }, (_, j) =>
      Array.from({ length: levels }, (_, k) => {
        const more = replaces.includes(k + 1) ? k + 1 : 1; // than all those below it
        const size = Math.round(bytes * (0.5 + random()) * (k ? 1 : 0.3) * more);
        const file = put(network, `chunks/l${cells * id + j}-${k + 1}-${seed}.spz`, size, random);
        return replaces.includes(k + 1) ? { ...file, refine: "REPLACE" as const } : file;
      }),
    );
    const uri = `chunks/l${id}-${seed}.sgst`;
    const label = labelOf(id, streams ? streamOf(network, uri, files, palette) : files, random);
    return palette ? { ...label, palette: paletteIn(network, uri, palette) } : label;
  });
  const models =
    promises && labels ? new TextEncoder().encode(JSON.stringify(promisesOf(made, random))) : null;
  return {
    ...manifestOf(made, models && store(network, PROMISES, models)),
    live,
    pack: pack ? packOf(network, made) : null,
  };
}

/** A manifest of some labels, and maybe their models of fidelity. */
export const manifestOf = (
  labels: readonly Label[],
  promises: Manifest["promises"]["fidelity"] | null,
): Manifest => ({
  format: "sagesplat-bundle",
  version: 1,
  generator: "test",
  name: "test",
  live: false,
  frame: { axes: "rub", up: [0, 1, 0], floor: -1, extent: 5, metersPerUnit: 1, scale: "given" },
  shDegree: 3,
  antialiased: false,
  background: [0, 0, 0],
  totals: totals(labels),
  gpuBytes: GPU_BYTES,
  labels,
  promises: promises ? { fidelity: promises } : {},
  target: { quality: "fidelity", value: 0.8 },
  pack: null,
  cameras: [],
  start: { position: [0, 0, 0], quaternion: [0, 0, 0, 1], target: [0, 0, -1] },
  licenses: [],
});

/** A manifest as JSON has it: levels of a stream together, and no keys. */
export function documentOf({ totals, labels, promises, ...manifest }: Manifest): documents.Manifest {
  const plain = <T extends { readonly key: string }>({ key: _, ...file }: T) => file;
  const { fidelity, ssim } = promises;
  return JSON.parse(
    JSON.stringify({
      ...manifest,
      totals: { count: totals.count, bytes: totals.bytes },
      labels: labels.map(({ palette, cells, ...label }) => ({
        ...label,
        palette: palette && plain(palette),
        cells: cells.map((cell) => ({ ...cell, levels: together(cell.levels) })),
      })),
      promises: { fidelity: fidelity && plain(fidelity), ssim: ssim && plain(ssim) },
    }),
  );
}

function together(levels: readonly Level[]): documents.Levels[] {
  const runs: Level[][] = [];
  for (const level of levels) {
    const run = runs.at(-1);
    if (run && level.format === "stream" && level.uri === run[0]?.uri && !level.refine) run.push(level);
    else runs.push([level]);
  }
  return runs.map((run) => {
    const { uri, format, offset, refine } = run[0] as Level;
    const weights = run.flatMap(({ weight }) => weight ?? []);
    const lists = { bytes: run.map(({ bytes }) => bytes), counts: run.map(({ count }) => count) };
    return {
      uri,
      format,
      ...(offset !== undefined && { offset }),
      ...(refine && { refine }),
      ...(weights.length && { weights }),
      ...lists,
      sha256: run.map(({ sha256 }) => sha256).join(""),
    };
  });
}

/** Puts the files of cells one after the other into one. */
function streamOf(
  network: Network,
  uri: string,
  cells: readonly (readonly Level[])[],
  palette: number,
): Level[][] {
  const content = new Uint8Array(cells.flat().reduce((sum, { bytes }) => sum + bytes, palette));
  let end = palette;
  const levels = cells.map((files) =>
    files.map((file) => {
      const offset = end;
      content.set(network.files.get(file.uri) ?? [], offset);
      network.files.delete(file.uri);
      end += file.bytes;
      return { ...file, uri, format: "stream" as const, offset, key: `${uri}:${offset}` };
    }),
  );
  network.files.set(uri, content);
  return levels;
}

/** The first bytes of a file. */
function paletteIn(network: Network, uri: string, bytes: number) {
  const content = network.files.get(uri)?.subarray(0, bytes) ?? new Uint8Array(0);
  const sha256 = fnv(content);
  return { uri, offset: 0 as const, bytes, sha256, key: sha256 };
}

/** All increments, level by level. */
export function packOf(network: Network, labels: readonly Label[]): Pack {
  const cells = labels.flatMap((label) => label.cells);
  const last = Math.max(0, ...cells.map(({ levels }) => levels.length));
  const order = Array.from({ length: last }, (_, k) => cells.map(({ id }) => [id, k + 1] as const)).flat();
  const contents = Array.from({ length: last }, (_, k) => cells.map(({ levels }) => levels[k])).flat();
  const content = new Uint8Array(contents.reduce((sum, one) => sum + (one?.bytes ?? 0), 0));
  let at = 0;
  for (const { uri, offset = 0, bytes } of contents.flatMap((one) => one ?? [])) {
    content.set(network.files.get(uri)?.subarray(offset, offset + bytes) ?? [], at);
    at += bytes;
  }
  return { ...store(network, "scene-1.pack", content), order };
}

export function store(network: Network, uri: string, content: Uint8Array) {
  network.files.set(uri, content);
  const sha256 = fnv(content);
  return { uri, bytes: content.length, sha256, key: sha256 };
}

function put(network: Network, uri: string, size: number, random: () => number): Level {
  const content = Uint8Array.from({ length: size }, () => Math.floor(256 * random()));
  const count = Math.max(1, Math.round(size / 20));
  return { ...store(network, uri, content), key: uri, format: "spz", gpuBytes: GPU_BYTES * count, count };
}

function labelOf(id: number, cells: readonly (readonly Level[])[], random: () => number): Label {
  const best = 0.88 + 0.08 * random();
  const means = (cells[0] ?? []).map((_, k) => best * (1 - 0.6 * Math.exp(-(k + 1) / 1.5)));
  const [left, wide] = [4 * id - 9, 2 / cells.length];
  return {
    id,
    name: `label-${id}`,
    title: `label ${id}`,
    color: "#808080",
    weight: 1,
    always: false,
    cells: cells.map((levels, j) =>
      cellOf(cells.length * id + j, [left + wide * j, -1, -6, left + wide * (j + 1), 1, -4], levels),
    ),
    quality: { fidelity: qualityOf(means) },
  };
}

/** Points of a cell as a manifest has them. */
export const base64 = (points: readonly number[]): string => btoa(String.fromCharCode(...points));

/** A cell that fills a box: points at its corners and in its middle. */
export function cellOf(id: number, bounds: Cell["bounds"], levels: readonly Level[]): Cell {
  const ends = [0, 255];
  const corners = ends.flatMap((x) => ends.flatMap((y) => ends.flatMap((z) => [x, y, z, 100])));
  const size = (axis: 0 | 1 | 2) => bounds[(axis + 3) as 3] - bounds[axis];
  const area = size(0) * size(1) + size(1) * size(2);
  return { id, bounds, points: base64([...corners, 128, 128, 128, 255]), area, radius: 0.2, levels };
}

/** What holds everywhere, for these means by level. */
export const qualityOf = (means: readonly number[]): LabelQuality => ({
  levels: means.map((_, k) => k + 1),
  status: "calibrated",
  confidence: 0.95,
  mean: means,
  bound: means.map((mean) => mean - 0.03),
});

/** A label's models, with the means of the label by level, that vary a little from view to view. */
export function modelsOf(label: Label, models: readonly CellPromises[]): LabelPromises {
  return {
    id: label.id,
    status: "calibrated",
    confidence: 0.95,
    leastSupport: 0,
    lengths: [0.5, 0.7, 0.8, 0.6],
    targets: [3000, 6000, 8000, 9000, 9900],
    thresholds: [3200, 6200, 8200, 9200, 9990],
    slopes: [0, 0, 0, 0, 0],
    cells: models,
  };
}

/** A cell's model, known at some rows of the shared views. */
export function modelOf(
  id: number,
  means: readonly number[],
  rows: readonly number[],
  random: () => number,
): CellPromises {
  return {
    id,
    ladder: means.map((_, k) => k + 1),
    medianLogDistance: 1.6,
    offsets: means.map((mean) => Math.round(1e4 * mean)),
    rows,
    logUnit: 0.01,
    logDistances: rows.map(() => Math.round(150 + 30 * random())),
    terms: means.map(() => rows.map(() => Math.round(2 * (random() - 0.5)))),
  };
}

const LOG_FIELD = 0.5 * Math.log(4 * 0.8 * 0.5); // of `at`'s lens

function promisesOf(labels: readonly Label[], random: () => number): Promises {
  const views = Array.from({ length: 12 }, () => [
    10 * random() - 5,
    0,
    4 * random(),
    0,
    0,
    -1,
    0,
    LOG_FIELD,
  ]);
  const rows = views.map((_, i) => i);
  const column = (axis: number) =>
    views.map((view) => Math.round((1e4 * (view[axis] ?? 0)) / (axis < 3 ? 5 : 1)));
  return {
    quality: "fidelity",
    extent: 5,
    focal: FOCAL,
    screens: [0.5, 2],
    fov: 53,
    levels: 16,
    views: [column(0), column(1), column(2), column(3), column(4), column(5), column(6), column(7)],
    photos: [column(0), column(1), column(2), column(3), column(4), column(5)],
    labels: labels.map((label) =>
      modelsOf(
        label,
        label.cells.map(({ id }) => ({
          ...modelOf(id, label.quality.fidelity?.mean ?? [], rows, random),
          factors: rows.map(() => Math.round(10 + 20 * random())),
        })),
      ),
    ),
  };
}

export function totals(labels: readonly Label[]): Manifest["totals"] {
  const cells = labels.flatMap((label) => label.cells);
  const all = cells.flatMap(({ levels }) =>
    levels.slice(
      Math.max(
        0,
        levels.findLastIndex((l) => l.refine),
      ),
    ),
  );
  const sum = (unit: "count" | "bytes" | "gpuBytes") => all.reduce((total, level) => total + level[unit], 0);
  return { count: sum("count"), bytes: sum("bytes"), gpuBytes: sum("gpuBytes") };
}
