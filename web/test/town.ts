/** A large scene made up for tests: categories with a cell in each block of a square, far ones the largest. */

import { rotate } from "../src/core/distance";
import type { Cell, Label, Level, Manifest, Promises, Viewpoint } from "../src/types";
import { type Network, seeded } from "./simulate";
import {
  cellOf,
  FOCAL,
  frustumOf,
  lensOf,
  manifestOf,
  modelOf,
  modelsOf,
  PROMISES,
  qualityOf,
  store,
} from "./worlds";

const SIDE = 10; // of a block, world units

export interface TownOptions {
  readonly side?: number; // blocks along it
  readonly categories?: number;
  readonly levels?: number;
  readonly bytes?: number; // of all levels of a cell nearby, about; of the farthest eight times as much
  readonly views?: number; // that a cell's model knows
}

/** Stands in the middle and looks along x: most blocks are behind or beside. */
export const start = { position: [18, 1.5, 15], quaternion: [0, -Math.SQRT1_2, 0, Math.SQRT1_2] } as const;

/** A bundle in side x side blocks along x and z; of increments only the sizes matter. */
export function townBundle(network: Network, options: TownOptions = {}): Manifest {
  const { side = 4, categories = 8, levels = 16, bytes = 24_000, views = 24 } = options;
  const random = seeded(5);
  const means = Array.from({ length: levels }, (_, k) => 0.95 * (1 - 0.5 * Math.exp(-(k + 1) / 4)));
  const labels = Array.from({ length: categories }, (_, id): Label => {
    const cells = Array.from({ length: side * side }, (_, block) => {
      const [column, row] = [block % side, Math.floor(block / side)];
      const far =
        Math.hypot(SIDE * (column + 0.5) - start.position[0], SIDE * (row + 0.5) - start.position[2]) / 4;
      const sizes = Array.from(
        { length: levels },
        (_, k) => (bytes * Math.max(1, far) * 1.3 ** k) / 1.3 ** levels,
      );
      return part(network, side * side * id + block, [SIDE * column, SIDE * row], sizes, random);
    });
    return {
      id,
      name: `category-${id}`,
      title: `category ${id}`,
      color: "#808080",
      weight: 1,
      always: false,
      cells,
      quality: { fidelity: qualityOf(means) },
    };
  });
  const models = promisesOf(labels, side, views, random);
  const promises = store(network, PROMISES, new TextEncoder().encode(JSON.stringify(models)));
  const manifest = manifestOf(labels, promises);
  return {
    ...manifest,
    frame: { ...manifest.frame, floor: 0, extent: SIDE * side },
    target: { quality: "fidelity", value: 0.95 },
    start: { ...start, target: [5, 1, 5] },
  };
}

function part(
  network: Network,
  id: number,
  [x, z]: readonly [number, number],
  sizes: readonly number[],
  random: () => number,
): Cell {
  const levels = sizes.map((size, k): Level => {
    const content = new Uint8Array(Math.max(8, Math.round(size)));
    new DataView(content.buffer).setUint32(0, 64 * id + k); // no two files are the same
    const count = Math.max(1, Math.round(size / 20));
    const uri = `chunks/p${id}-${k + 1}.spz`;
    return {
      ...store(network, uri, content),
      key: uri,
      format: "spz",
      gpuBytes: 56 * count,
      count,
    };
  });
  const [a, b] = [x + 4 * random(), z + 4 * random()];
  return cellOf(id, [a, 0, b, a + 6, 1 + 2 * random(), b + 6], levels);
}

const LOG_FIELD = 0.2; // about that of the visitor's lens

/** Each cell is known from views in and around its block. */
function promisesOf(labels: readonly Label[], side: number, views: number, random: () => number): Promises {
  const all = Array.from({ length: side * side * views }, () => {
    const turn = 2 * Math.PI * random();
    const [x, z] = [SIDE * side * random(), SIDE * side * random()];
    return [x, 1.5, z, Math.sin(turn), 0, Math.cos(turn), 0, LOG_FIELD] as const;
  });
  const extent = SIDE * side;
  const column = (axis: number) =>
    all.map((view) => Math.round((1e4 * (view[axis] ?? 0)) / (axis < 3 ? extent : 1)));
  return {
    quality: "fidelity",
    extent,
    focal: FOCAL,
    screens: [0.5, 2],
    levels: 16,
    views: [column(0), column(1), column(2), column(3), column(4), column(5), column(6), column(7)],
    photos: [column(0), column(1), column(2), column(3), column(4), column(5)],
    labels: labels.map((label) => {
      const models = label.cells.map(({ id, bounds: [x, , z] }) => {
        const away = all.map((view) => Math.hypot(view[0] - x, view[2] - z));
        const nearest = [...away.keys()].sort((a, b) => (away[a] ?? 0) - (away[b] ?? 0)).slice(0, views);
        const rows = nearest.sort((a, b) => a - b);
        return {
          ...modelOf(id, label.quality.fidelity?.mean ?? [], rows, random),
          medianLogDistance: 2,
          logDistances: rows.map((row) => Math.round(100 * Math.log(1 + (away[row] ?? 0)))),
          factors: all.map(() => Math.round(20 * random())),
        };
      });
      return { ...modelsOf(label, models), lengths: [0.2, 0.7, 0.8, 0.6] as const };
    }),
  };
}

/** The viewpoint at the start, turned about the vertical. */
export function startView(turn = 0): Viewpoint {
  const half = -Math.PI / 4 + turn / 2;
  const quaternion = [0, Math.sin(half), 0, Math.cos(half)] as const;
  const frustum = frustumOf(start.position, quaternion, 0.9, 1.6);
  return {
    position: start.position,
    direction: rotate(quaternion, [0, 0, -1]),
    frustum,
    lens: lensOf(0.9, 1.6),
  };
}
