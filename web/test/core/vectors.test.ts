/** How viewpoints see cells, and promises: by hand, and against those of the Python package. */

import { describe, expect, test } from "vitest";
import distances from "../../../tests/data/distances.json?raw";
import promised from "../../../tests/data/promises.json?raw";
import { Points } from "../../src/core/distance";
import { parsePromises } from "../../src/core/manifest";
import {
  boundOf,
  type CellModel,
  curveAt,
  LabelModel,
  meansAnywhere,
  neededFor,
  outlookAnywhere,
  Views,
} from "../../src/core/quality";
import { entriesOf } from "../../src/core/residency";
import { familiesOf, ViewpointModels } from "../../src/core/viewpoints";
import type { Cell, CellPromises, Curve, Label, LabelPromises, Promises, Viewpoint } from "../../src/types";
import { Network, VirtualClock } from "../simulate";
import { at, base64, bundle, frustumOf, modelsOf } from "../worlds";

/** Null: NaN, or of a focal length, the photos'. */
type Maybe = number | null;
type Place = Omit<Cell, "levels">;
type Pose = Pick<Viewpoint, "position" | "direction">;

interface DistanceCase {
  readonly name: string;
  readonly cells: readonly Place[];
  readonly camera: Viewpoint;
  readonly expected: {
    readonly visible: readonly boolean[];
    readonly distance: readonly Maybe[];
    readonly apparent: readonly number[];
    readonly whole: Maybe; // of all cells as one label
  };
}
interface SsimView extends Pose {
  readonly focal: Maybe;
  readonly distance: Maybe;
  readonly corrected: Maybe;
  readonly mean: readonly number[]; // by level of the model
  readonly bound: readonly Maybe[];
  readonly support: number;
}
interface FidelityView extends Viewpoint {
  readonly focal: number;
  readonly levels: readonly number[]; // of a composition, from 1, by cell
  readonly expected: {
    readonly share: readonly number[]; // by cell
    readonly means: readonly (readonly number[] | null)[]; // by cell in sight and level
    readonly away: number; // from the photos
    readonly support: readonly number[]; // by label
    readonly mean: readonly Maybe[]; // of the composition
    readonly bound: readonly Maybe[];
    readonly last: readonly Maybe[]; // bound of the last levels
  };
}
interface FidelityCase {
  readonly name: string;
  readonly labels: readonly { readonly id: number; readonly cells: (Place & { numLevels: number })[] }[];
  readonly promises: Promises; // packed
  readonly viewpoints: readonly FidelityView[];
}
interface SsimCase extends Pick<FidelityCase, "name" | "promises"> {
  readonly viewpoints: readonly SsimView[];
}

const EXACT = 1e-9;
const SINGLE = 1e-5; // cameras of the Python package have single precision

function near(found: number, expected: Maybe, what: string, tolerance: number): void {
  if (expected === null) expect(found, what).toBeNaN();
  else {
    const most = tolerance * Math.max(1e-3, Math.abs(expected));
    expect(Math.abs(found - expected), `${what}: ${found}, not ${expected}`).toBeLessThanOrEqual(most);
  }
}

const level = { uri: "a.spz", format: "spz", bytes: 1, gpuBytes: 1, count: 1, key: "", sha256: "" } as const;
const levelled = (place: Place, count: number): Cell => ({
  ...place,
  levels: Array.from({ length: count }, () => level),
});
const somewhere: Place = {
  id: 0,
  bounds: [0, 0, 0, 1, 1, 1],
  points: base64([0, 0, 0, 1]),
  area: 1,
  radius: 1,
};
const labelOf = (id: number, cells: readonly Cell[]): Label => ({
  id,
  name: "label",
  title: "label",
  color: "#000000",
  weight: 1,
  always: false,
  cells,
  quality: {},
});

const distanceCases = (JSON.parse(distances) as { cases: DistanceCase[] }).cases;
test.each(distanceCases)("distances are those of the Python package: $name", (one) => {
  const { cells, camera, expected } = one;
  const points = cells.map((place) => new Points(levelled(place, 1)));
  for (const [i, { visible, distance, apparent }] of points.map((each) => each.look(camera)).entries()) {
    expect(visible).toBe(expected.visible[i]);
    near(distance, expected.distance[i] as Maybe, "distance", SINGLE);
    near(apparent, expected.apparent[i] as number, "apparent", SINGLE);
  }
  near(Points.together(points), expected.whole, "of all", SINGLE);
});

const promiseCases = (JSON.parse(promised) as { cases: (SsimCase | FidelityCase)[] }).cases;
const isOfCells = (one: SsimCase | FidelityCase): one is FidelityCase => one.promises.quality === "fidelity";

test.each(promiseCases.filter((one): one is SsimCase => !isOfCells(one)))(
  "ssim is that of the Python package: $name",
  (one) => {
    const { viewpoints } = one;
    const promises = parsePromises(JSON.stringify(one.promises), one.name, "ssim");
    const [own] = promises.labels as readonly [LabelPromises];
    const known = own.cells[0]?.levels ?? [];
    const views = new Views(promises);
    const model = new LabelModel(labelOf(own.id, [levelled(somewhere, Math.max(...known))]), views, own);
    const { whole } = model as { whole: CellModel };
    for (const { position, direction, focal, ...expected } of viewpoints) {
      const distance = expected.distance ?? Number.NaN;
      views.from({ ...at(0), position, direction, ...(focal !== null && { focal }) });
      near(whole.corrected(distance), expected.corrected, "corrected", EXACT);
      const { support, keeps } = model.outlook(distance);
      near(support, expected.support, "support", EXACT);
      const mean = whole.mean(distance);
      expect(mean.filter((value) => !Number.isNaN(value))).toHaveLength(known.length);
      for (const [k, of] of known.entries()) {
        const found = mean[of - 1] as number;
        near(found, expected.mean[k] as number, "mean", EXACT);
        near(keeps ? boundOf(keeps, found) : Number.NaN, expected.bound[k] as Maybe, "bound", EXACT);
      }
    }
  },
);

test.each(promiseCases.filter(isOfCells))("fidelity is that of the Python package: $name", (one) => {
  const { viewpoints } = one;
  const promises = parsePromises(JSON.stringify(one.promises), one.name, "fidelity");
  const labels = one.labels.map(({ id, cells }) =>
    labelOf(
      id,
      cells.map(({ numLevels, ...place }) => levelled(place, numLevels)),
    ),
  );
  const families = familiesOf(entriesOf(labels));
  const models = new ViewpointModels(promises.quality, labels, promises);
  const views = new Views(promises);
  for (const { levels, expected, ...viewpoint } of viewpoints) {
    models.see(families, viewpoint);
    views.from(viewpoint);
    near(views.fromPhotos, expected.away, "away", SINGLE);
    for (const [i, { entries, outlook }] of families.entries()) {
      let [sum, last, total] = [0, 0, 0];
      for (const { cell, mean, share, sight } of entries) {
        near(share, expected.share[cell.id] as number, "share", SINGLE);
        const means = expected.means[cell.id] as readonly number[] | null;
        expect(sight.visible).toBe(means !== null);
        if (!means) continue;
        expect(mean).toHaveLength(means.length);
        for (const [k, value] of means.entries()) near(mean[k] as number, value, "mean", SINGLE);
        sum += share * (mean[(levels[cell.id] as number) - 1] as number);
        last += share * (mean.at(-1) as number);
        total += share;
      }
      near(sum / total, expected.mean[i] as Maybe, "of the composition", SINGLE);
      if (!total) continue;
      near(outlook.support, expected.support[i] as number, "support", SINGLE);
      const { keeps } = outlook;
      const bound = (mean: number) => (keeps ? boundOf(keeps, mean) : Number.NaN);
      near(bound(sum / total), expected.bound[i] as Maybe, "bound", SINGLE);
      near(bound(last / total), expected.last[i] as Maybe, "bound of the last levels", SINGLE);
    }
  }
});

describe("points", () => {
  /** Two points at x = 1 and x = 3, of a quarter and three quarters of the area. */
  const cell: Cell = {
    id: 0,
    bounds: [1, 0, -2, 3, 0, -2],
    points: base64([0, 0, 0, 50, 255, 0, 0, 150]),
    area: 4,
    radius: 0.5,
    levels: [level],
  };
  const view: Viewpoint = { ...at(0), lens: [1, 0.5] };

  test("stand for an area that is as large as it is near", () => {
    const { visible, distance, apparent, potential } = new Points(cell).look(view);
    expect(visible).toBe(true);
    expect(apparent).toBeCloseTo((1 / 2) * (1 / 5 + 3 / 13), 12);
    expect(potential).toBe(apparent);
    expect(distance).toBeCloseTo(Math.sqrt(5), 12); // a quarter of the weight is there
  });

  test("count by how far they are inside", () => {
    const upTo = (x: number): Viewpoint => ({ ...view, frustum: [[-1, 0, 0, x]] });
    const points = new Points(cell);
    expect(points.look(upTo(1.25)).apparent).toBeCloseTo((0.75 * 1) / 2 / 5, 12);
    expect(points.look(upTo(3)).apparent).toBeCloseTo((1 / 2) * (1 / 5 + 1.5 / 13), 12);
    expect(points.look(upTo(3)).distance).toBeCloseTo(Math.sqrt(5), 12);
    const behind = points.look(upTo(0.5));
    expect(behind).toMatchObject({ visible: false, distance: Number.NaN, apparent: 0 });
    expect(behind.potential).toBeCloseTo((1 / 2) * (1 / 5 + 3 / 13), 12);
  });

  test("of all cells say how far a label is", () => {
    const far = { ...cell, id: 1, bounds: [1, 0, -20, 3, 0, -20] } as const;
    const both = [new Points(far), new Points(cell)];
    for (const points of both) points.look(view);
    expect(Points.together(both)).toBeCloseTo(Math.sqrt(5), 12);
    for (const points of both) points.look({ ...view, frustum: [[0, 0, 1, -5]] });
    expect(Points.together(both)).toBeNaN();
  });

  test("where there are none, or of no area, nothing is in sight", () => {
    for (const points of [[], [1, 2, 3, 0]]) {
      expect(new Points({ ...cell, points: base64(points) }).look(view)).toMatchObject({
        visible: false,
        potential: 0,
      });
    }
    const here = new Points({ ...cell, bounds: [0, 0, 0, 0, 0, 0], radius: 0 }).look(view);
    expect(here.apparent).toBeLessThan(Infinity);
  });
});

const promises = (): { labels: readonly Label[]; promises: Promises } => {
  const network = new Network(new VirtualClock());
  const { labels } = bundle(network, { labels: 2, cells: 2 });
  return { labels, promises: JSON.parse(new TextDecoder().decode(network.files.get("promises-1.json"))) };
};

describe("models", () => {
  const facing = { ...at(0), frustum: frustumOf([0, 0, 0], [0, 0, 0, 1], 2, 2) };

  test("shares of cells are at most the picture, by what is known nearby", () => {
    const { labels, promises: sent } = promises();
    const all = (factors: number[]): Promises => ({
      ...sent,
      labels: sent.labels.map((one) => ({
        ...one,
        cells: one.cells.map((own) => ({ ...own, factors })),
      })),
    });
    const shares = (factors: number[], viewpoint = at(-6)) => {
      const families = familiesOf(entriesOf(labels));
      new ViewpointModels("fidelity", labels, all(factors)).see(families, viewpoint);
      return families.flatMap(({ entries }) => entries);
    };
    const views = sent.views[0].length;
    const plain = shares(Array(views).fill(20));
    for (const { share, sight } of plain) expect(share).toBeCloseTo(sight.apparent, 12);
    for (const { share, sight } of shares(Array(views).fill(10))) {
      expect(share).toBeCloseTo(0.5 * sight.apparent, 12);
    }
    for (const { share, sight } of shares(Array(views).fill(-1))) expect(share).toBe(sight.apparent);
    const crowded = shares(Array(views).fill(200_000));
    expect(crowded.reduce((sum, { share }) => sum + share, 0)).toBeCloseTo(1, 9);
    // a view that is here decides
    const { extent } = sent;
    const x = (sent.views[0][0] ?? 0) * 1e-4 * extent;
    const z = (sent.views[2][0] ?? 0) * 1e-4 * extent;
    const one = shares([0, ...Array(views - 1).fill(-1)], at(x, 0, z));
    for (const { share, sight } of one) expect(share).toBeLessThanOrEqual(1e-2 * sight.apparent);
  });

  test("a cell that no view shows has the mean that is sent, and its label's promise", () => {
    const { labels, promises: sent } = promises();
    const bare = (own: CellPromises): CellPromises => ({
      ...own,
      rows: [],
      logDistances: [],
      terms: [],
    });
    const all = {
      ...sent,
      labels: sent.labels.map((one) => ({ ...one, leastSupport: 0.01, cells: one.cells.map(bare) })),
    };
    const families = familiesOf(entriesOf(labels));
    const models = new ViewpointModels("fidelity", labels, all);
    models.see(families, at(-6));
    for (const { entries, outlook, label } of families) {
      expect(outlook.trust).toBe("calibrated");
      const sent = label.quality.fidelity?.mean.map((mean) => Math.round(1e4 * mean) / 1e4);
      for (const { mean } of entries) expect(mean).toEqual(sent);
    }
    models.see(families, at(1e4));
    for (const { outlook } of families) expect(outlook).toMatchObject({ keeps: null, trust: "outside" });
  });

  test("screens beyond those that are known count as the nearer end, none as the photos'", () => {
    const { labels, promises: sent } = promises();
    const label = labels[0] as Label;
    const views = new Views(sent);
    const own = sent.labels[0];
    if (!own) throw new Error("no model");
    const model = new LabelModel(label, views, own);
    const from = (screen?: number) => {
      views.from({ ...facing, ...(screen !== undefined && { focal: screen * sent.focal }) });
      return [model.cells[0]?.mean(5), model.outlook().support];
    };
    expect(sent.screens).toEqual([0.5, 2]);
    expect(from(9)).toEqual(from(2));
    expect(from(0.01)).toEqual(from(0.5));
    expect(from()).toEqual(from(1));
    expect(from(2)).not.toEqual(from(1));
  });

  test("of ssim all cells of a label have its mean", () => {
    const { labels, promises: sent } = promises();
    const whole = {
      ...sent,
      quality: "ssim" as const,
      labels: sent.labels.map((one) => {
        const [first] = one.cells as readonly [CellPromises];
        const { factors: _, ...own } = first;
        return { ...modelsOf({ id: one.id } as Label, []), cells: [{ ...own, id: -1 }] };
      }),
    };
    const families = familiesOf(entriesOf(labels));
    const models = new ViewpointModels("ssim", labels, whole);
    models.see(families, at(-6));
    const settings = { mode: "target", target: 0.8, weights: new Map() } as never;
    for (const family of families) {
      const [a, b] = family.entries;
      expect(a?.mean).toEqual(b?.mean);
      expect(a?.mean.every((mean) => mean > 0)).toBe(true);
      const { cells, bound } = models.group(
        family,
        settings,
        ({ cell }) => cell.levels.length,
        () => false,
      );
      expect(cells).toHaveLength(1);
      expect(cells[0]?.ladder.bytes[4]).toBe((a?.ladder.bytes[4] ?? 0) + (b?.ladder.bytes[4] ?? 0));
      expect(bound).toHaveLength(5);
    }
  });
});

const curve: Curve = {
  level: 1,
  params: [0.9, 0.1, 1, 1, 0.8, 0.05, 1, 1, 3],
  range: [0.5, 8],
  median: 0.7,
};

test("a curve ends where its range ends, and says its median where the distance is unknown", () => {
  expect(curveAt(curve, 1)).toBe(0.9);
  expect(curveAt(curve, 3)).toBeCloseTo(0.8 * Math.exp(-0.1), 12);
  expect(curveAt(curve, 100)).toBe(curveAt(curve, 8));
  expect(curveAt(curve, 0)).toBe(curveAt(curve, 0.5));
  expect(curveAt(curve, Infinity)).toBe(curveAt(curve, 8));
  expect(curveAt(curve, Number.NaN)).toBe(0.7);
});

test("what a target needs is what keeps it", () => {
  const keeps = { targets: [0.3, 0.6, 0.9], needed: [0.4, 0.65, 1] };
  expect(neededFor(keeps, 0.3)).toBeCloseTo(0.4, 12);
  expect(neededFor(keeps, 0.45)).toBeCloseTo(0.525, 12);
  expect(neededFor(keeps, 0.1)).toBeCloseTo(0.2, 12);
  expect(neededFor(keeps, 0.9)).toBe(1);
  expect(neededFor(keeps, 0.95)).toBe(Infinity);
  for (const target of [0.05, 0.3, 0.5, 0.6, 0.77, 0.9]) {
    expect(boundOf(keeps, neededFor(keeps, target))).toBeCloseTo(target, 12);
  }
  expect(boundOf(keeps, Number.NaN)).toBeNaN();
});

test("before the models are there: levels without a prediction are unknown, bounds never fall", () => {
  const known = {
    levels: [2, 3],
    status: "calibrated",
    confidence: 0.95,
    mean: [0.7, 0.8],
    bound: [0.6, 0.7],
  } as const;
  expect(meansAnywhere(known, 4)).toEqual([Number.NaN, 0.7, 0.8, Number.NaN]);
  expect(meansAnywhere({ ...known, mean: [0.8, 0.7] }, 3)).toEqual([Number.NaN, 0.75, 0.75]);
  expect(meansAnywhere(undefined, 2)).toEqual([Number.NaN, Number.NaN]);
  const { keeps, trust } = outlookAnywhere(known);
  expect(trust).toBe("calibrated");
  expect(keeps && boundOf(keeps, 0.75)).toBeCloseTo(0.65, 12);
  expect(outlookAnywhere({ ...known, bound: null })).toMatchObject({ keeps: null, trust: "unknown" });
  expect(outlookAnywhere(undefined)).toMatchObject({ keeps: null, trust: "unknown" });
});
