/** Where a camera may go: near known viewpoints, and not into surfaces. */

import { Matrix4, Vector3 } from "three";
import { expect, test } from "vitest";
import type { Manifest, Promises, Vec3 } from "../../src/types";
import { Bounds } from "../../src/view/bounds";
import { dolly, type Rig, walk } from "../../src/view/motion";
import { Network, VirtualClock } from "../simulate";
import { base64, bundle } from "../worlds";

const IDENTITY = new Matrix4();
const at = (position: Vec3, reach = 4): Rig => ({ position, yaw: 0, pitch: 0, roll: 0, reach }); // looks along -z

/** A scene of 10 units with a wall at z = -4, photographed from the origin. */
function made(known = true): Bounds {
  const plain = bundle(new Network(new VirtualClock()), { labels: 1, levels: 1 });
  const [label] = plain.labels;
  const [cell] = label?.cells ?? [];
  if (!label || !cell) throw new Error("no cell");
  const wall = {
    ...cell,
    bounds: [-1, -1, -4, 1, 1, -4] as const,
    points: base64([128, 128, 0, 255]),
    area: 0,
  };
  const manifest: Manifest = {
    ...plain,
    frame: { ...plain.frame, extent: 10, metersPerUnit: 1 },
    start: { ...plain.start, position: [0, 0, 0] },
    cameras: [],
    labels: [{ ...label, cells: [wall] }],
  };
  const bounds = new Bounds(manifest, IDENTITY);
  const views = [
    [10_000, 1000],
    [0, 0],
    [0, 0],
  ]; // in differences: at x = 10 and 11
  if (known) bounds.know({ views, extent: 10 } as unknown as Promises, manifest.frame);
  return bounds;
}

test("far from all known viewpoints nobody gets; along them one walks", () => {
  const bounds = made();
  const back = bounds.confine(at([0, 0, 0]), at([0, 0, 20]));
  expect(back.position[2]).toBeCloseTo(2.5, 2);
  expect(bounds.confine(at([0, 0, 0]), at([0, 0, 2]))).toEqual(at([0, 0, 2]));
  expect(bounds.confine(at([10, 0, 0]), at([13, 0, 0]))).toEqual(at([13, 0, 0]));
  expect(bounds.confine(at([10, 0, 0]), at([10, 0, 9])).position[2]).toBeCloseTo(2.5, 2);
});

test("who is far out comes back, and a setting lifts all limits", () => {
  const bounds = made();
  expect(bounds.confine(at([0, 0, 30]), at([0, 0, 20]))).toEqual(at([0, 0, 20]));
  bounds.isOn = false;
  expect(bounds.confine(at([0, 0, 0]), at([0, 0, 90]))).toEqual(at([0, 0, 90]));
  expect(bounds.step(at([0, 0, -3.9]))).toBe(Infinity);
});

test("before promises are there, photos alone allow more", () => {
  expect(made(false).confine(at([0, 0, 0]), at([0, 0, 9]))).toEqual(at([0, 0, 9]));
});

test("the point that one turns around stays while one is held back", () => {
  const from = at([0, 0, 0], 4);
  const to = dolly(from, 3);
  const held = made().confine(from, to);
  expect(held.position[2] - held.reach).toBeCloseTo(-4, 6);
});

test("twenty steps closer end before the surface, each shorter; away from it there is room", () => {
  const bounds = made();
  let [rig, last] = [at([0, 0, 0]), Infinity];
  for (let i = 0; i < 20; i++) {
    const step = bounds.step(rig);
    expect(step).toBeLessThan(last);
    last = step;
    rig = walk(rig, 0, 0, step);
  }
  expect(new Vector3(...rig.position).distanceTo(new Vector3(0, 0, -4))).toBeGreaterThan(0.45);
  expect(bounds.step({ ...at([0, 0, 0]), yaw: Math.PI })).toBe(Infinity);
});
