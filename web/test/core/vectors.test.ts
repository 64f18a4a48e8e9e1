/** Promises and distances against those of the Python package. */

import { describe, expect, test } from "vitest";
import distances from "../../../tests/data/distances.json?raw";
import promised from "../../../tests/data/promises.json?raw";
import { type Lens, look, photoFrustum, rotate, touches, widestLens } from "../../src/core/distance";
import { anywhere, curveAt, ViewModel, Views } from "../../src/core/quality";
import type { Box, Camera, Curve, Label, Promises, Quat, Vec3, Viewpoint } from "../../src/types";
import { differences, frustumOf } from "../worlds";

interface PromiseCase {
  name: string;
  promises: Promises;
  viewpoints: {
    position: Vec3;
    direction: Vec3;
    focal: number | null;
    distance: number | null;
    corrected: number | null;
    mean: number[];
    bound: (number | null)[];
    support: number;
  }[];
}

interface DistanceCase {
  name: string;
  boxes: Box[];
  camera: { position: Vec3; quaternion: Quat; fovY: number; aspect: number };
  frustum: Viewpoint["frustum"];
  lens: Lens;
  photo: Viewpoint["frustum"];
  expected: { distance: number | null; inPhoto: number | null; visible: boolean; touching: boolean[] };
}

function near(found: readonly number[], expected: readonly number[], relative = 0): void {
  expect(found).toHaveLength(expected.length);
  expected.forEach((value, i) => {
    const away = Math.abs((found[i] ?? Number.NaN) - value);
    expect(away).toBeLessThanOrEqual(1e-9 * Math.max(1, relative * Math.abs(value)));
  });
}

const labelWith = (levels: number): Label => ({
  id: 7,
  name: "label",
  title: "label",
  color: "#000000",
  weight: 1,
  always: false,
  boxes: [],
  levels: Array.from({ length: levels }, () => ({
    uri: "a.spz",
    format: "spz",
    bytes: 1,
    gpuBytes: 1,
    count: 1,
    sha256: "",
  })),
  quality: {},
});

describe("promises", () => {
  for (const c of (JSON.parse(promised) as { cases: PromiseCase[] }).cases) {
    test(c.name, () => {
      const own = c.promises.labels[0];
      if (!own) throw new Error("no label");
      const label = labelWith(Math.max(...own.levels));
      expect(ViewModel.fits(label, own)).toBe(true);
      const model = new ViewModel(label, new Views(c.promises), own);
      const ofLevels = (values: readonly number[]) => own.levels.map((k) => values[k - 1] ?? Number.NaN);
      for (const v of c.viewpoints) {
        const { position, direction, focal } = v;
        const from = { position, direction, ...(focal !== null && { focal }) };
        const told = model.predict(v.distance ?? Number.NaN, from);
        near(ofLevels(told.mean), v.mean);
        v.bound.forEach((value, k) => {
          if (value === null) expect(ofLevels(told.bound)[k]).toBeNaN();
          else near([ofLevels(told.bound)[k] ?? Number.NaN], [value]);
        });
        near([told.support], [v.support]);
        const outside = v.support < own.leastSupport;
        expect(told.trust).toBe(outside ? "outside" : own.targets.length ? own.status : "unknown");
        const right = model.corrected(v.distance ?? Number.NaN, from);
        if (v.corrected === null) expect(right).toBeNaN();
        else near([right], [v.corrected], 1);
        label.levels.forEach((_, k) => {
          expect(Number.isNaN(told.mean[k])).toBe(!own.levels.includes(k + 1));
        });
      }
    });
  }
});

describe("distances", () => {
  for (const c of (JSON.parse(distances) as { cases: DistanceCase[] }).cases) {
    test(c.name, () => {
      const { position, quaternion, fovY, aspect } = c.camera;
      const planes = frustumOf(position, quaternion, fovY, aspect);
      near(planes.flat(), c.frustum.flat());
      const viewpoint = { position, direction: rotate(quaternion, [0, 0, -1]), frustum: planes };
      const sight = look(c.boxes, viewpoint);
      expect(sight.visible).toBe(c.expected.visible);
      expect(c.boxes.map((box) => touches(box, planes))).toEqual(c.expected.touching);
      if (c.expected.distance === null) expect(sight.distance).toBeNaN();
      else near([sight.distance], [c.expected.distance], 1);
      const photo = photoFrustum(viewpoint, c.lens);
      near(photo.flat(), c.photo.flat());
      const inPhoto = look(c.boxes, viewpoint, photo);
      if (c.expected.inPhoto === null) expect(inPhoto.distance).toBeNaN();
      else near([inPhoto.distance], [c.expected.inPhoto], 1);
      expect({ ...inPhoto, distance: 0 }).toEqual({ ...sight, distance: 0 });
    });
  }
});

test("a frustum that is no wider than the photos is that of the window", () => {
  const viewpoint = {
    position: [0, 0, 0],
    direction: [0, 0, -1],
    frustum: frustumOf([0, 0, 0], [0, 0, 0, 1], 1, 1),
  };
  const window = viewpoint as unknown as Viewpoint;
  expect(photoFrustum(window, [0.6, 0.6])).toBe(window.frustum);
  expect(photoFrustum(window, null)).toBe(window.frustum);
  expect(photoFrustum({ ...window, frustum: [] }, [0.1, 0.1])).toEqual([]);
});

test("the lens is that of the photos, and of other shapes of their area", () => {
  expect(widestLens([])).toBeNull();
  const long = { width: 300, height: 40, intrinsics: [100, 160, 150, 20] } as unknown as Camera;
  const shaped = Math.sqrt((300 * 40 * 20) / 9) / (2 * Math.sqrt(100 * 160)); // of the long one
  near(widestLens([long, { ...long, width: 30 }]) ?? [], [1.5, shaped]);
  const square = { ...long, width: 100, height: 100, intrinsics: [100, 100, 50, 50] } as const;
  const half = Math.sqrt(20 / 9) / 2;
  near(widestLens([square]) ?? [], [half, half]);
});

test("screens beyond those that are known count as the nearer end, none as the photos'", () => {
  const { promises } = (JSON.parse(promised) as { cases: PromiseCase[] }).cases[5] ?? {};
  const own = promises?.labels[0];
  if (!own) throw new Error("no case");
  const model = new ViewModel(labelWith(5), new Views(promises), own);
  const at = (screen?: number) => {
    const focal = screen === undefined ? {} : { focal: screen * promises.focal };
    return model.predict(2, { position: [0, 0, 0], direction: [0, 0, -1], ...focal });
  };
  expect(promises.screens).toEqual([0.5, 2]);
  expect(at(9)).toEqual(at(2));
  expect(at(0.01)).toEqual(at(0.5));
  expect(at()).toEqual(at(1));
  expect(at(2).mean).not.toEqual(at(1).mean);
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

test("before the models are there: levels without a prediction are unknown, bounds never fall", () => {
  const known = {
    levels: [2, 3],
    status: "calibrated",
    confidence: 0.95,
    mean: [0.8, 0.7],
    bound: [0.6, 0.5],
  } as const;
  const label: Label = { ...labelWith(4), quality: { ssim: known } };
  const { mean, bound, trust } = anywhere(label, "ssim");
  expect(mean).toEqual([Number.NaN, 0.75, 0.75, Number.NaN]);
  expect(bound).toEqual([Number.NaN, 0.6, 0.6, Number.NaN]);
  expect(trust).toBe("calibrated");
  const unknown = [1, 2, 3, 4].map(() => Number.NaN);
  const none = anywhere({ ...label, quality: { ssim: { ...known, bound: null } } }, "ssim");
  expect([none.bound, none.trust]).toEqual([unknown, "unknown"]);
  expect(anywhere(label, "fidelity")).toMatchObject({ mean: unknown, bound: unknown, trust: "unknown" });
});

test("shares of pixels come from the views near by", () => {
  const own = (JSON.parse(promised) as { cases: PromiseCase[] }).cases[4];
  if (!own?.promises.labels[0]) throw new Error("no case");
  const count = own.promises.views[0]?.length ?? 0;
  const shares = differences(Array.from({ length: count }, (_, i) => (i === 3 ? 5000 : 1000)));
  const entry = { ...own.promises.labels[0], shares, lengths: [0.01, 0.01, 1, 1] as const };
  const views = new Views(own.promises);
  const model = new ViewModel(labelWith(6), views, entry);
  const [x, y, z, a, b, c] = [...views.rows.slice(21, 27)] as [
    number,
    number,
    number,
    number,
    number,
    number,
  ];
  const { extent } = own.promises;
  const there = [x * extent, y * extent, z * extent] as const;
  for (const focal of [1, 1e4]) // of place alone
    expect(model.share({ position: there, direction: [a, b, c], focal })).toBeCloseTo(0.5, 6);
  const away = model.share({ position: [1e4, 0, 0], direction: [0, 0, 1] });
  expect(away).toBeCloseTo(0.1 + 0.4 / count, 9);
});
