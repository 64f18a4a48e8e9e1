import { Matrix4, PerspectiveCamera, Vector3 } from "three";
import { expect, test } from "vitest";
import type { Camera, Manifest } from "../../src/types";
import { focalOf, lens, rootMatrix, transformPose, viewpoint } from "../../src/view/frame";

const frame: Manifest["frame"] = {
  axes: "rub",
  up: [0.6, 0.8, 0],
  floor: -2,
  extent: 1,
  metersPerUnit: 0.5,
  scale: "given",
};

test("the root puts the ground at 0, up at +y, and counts in metres", () => {
  const root = rootMatrix(frame);
  const ground = new Vector3(0.6 * -2, 0.8 * -2, 0).applyMatrix4(root);
  expect(ground.length()).toBeCloseTo(0, 9);
  const above = new Vector3(0.6 * 4, 0.8 * 4, 0).applyMatrix4(root);
  expect(above.toArray().map((v) => Math.abs(Math.round(v * 1e9) / 1e9))).toEqual([0, 3, 0]);
});

test("a pose comes back through the inverse", () => {
  const root = rootMatrix(frame);
  const pose = { position: [1, 2, 3], quaternion: [0, 0.6, 0, 0.8] } as const;
  const back = transformPose(transformPose(pose, root), root.clone().invert());
  for (const i of [0, 1, 2] as const) expect(back.position[i]).toBeCloseTo(pose.position[i], 9);
  for (const i of [0, 1, 2, 3] as const) expect(back.quaternion[i]).toBeCloseTo(pose.quaternion[i], 9);
});

test("the frustum holds what is in the picture, as near as can be", () => {
  const root = rootMatrix(frame);
  const camera = new PerspectiveCamera(50, 1.6, 0.1, 100);
  camera.position.set(1, 2, 3);
  camera.lookAt(0, 1, 0);
  camera.updateMatrixWorld();
  const { frustum, position, direction, focal } = viewpoint(
    root,
    camera.matrixWorld,
    camera.projectionMatrix,
    700,
  );
  expect(new Vector3(...direction).length()).toBeCloseTo(1, 9);
  expect(focal).toBe(700);
  const inside = (point: Vector3) =>
    frustum.every(([x, y, z, d]) => x * point.x + y * point.y + z * point.z + d >= 0);
  const toBundle = new Matrix4().copy(root).invert();
  for (let i = 0; i < 300; i += 1) {
    const ndc = new Vector3(Math.sin(i * 1.7) * 1.5, Math.cos(i * 2.3) * 1.5, 0.9);
    const seen = Math.abs(ndc.x) < 1 && Math.abs(ndc.y) < 1;
    expect(inside(ndc.unproject(camera).applyMatrix4(toBundle))).toBe(seen);
  }
  const near = new Vector3(...position).addScaledVector(new Vector3(...direction), 1e-4);
  expect(inside(near)).toBe(true);
});

const photo: Camera = {
  name: "a",
  split: "train",
  position: [0, 0, 0],
  quaternion: [0, 0, 0, 1],
  fovY: 1,
  width: 320,
  height: 200,
  intrinsics: [230, 225, 155, 104],
};

test("a photo's lens keeps its principal point on any canvas of its height", () => {
  expect(lens(photo, 320, 200)).toEqual([-155 / 230, 165 / 230, 104 / 225, -96 / 225]);
  const [left, right, top, bottom] = lens(photo, 640, 400);
  const projection = new Matrix4().makePerspective(left, right, top, bottom, 1, 2);
  // the photo's own focal length, on twice its height; and that of a field of view
  expect(focalOf(projection, 640, 400)).toBeCloseTo(2 * Math.sqrt(230 * 225), 9);
  const { projectionMatrix } = new PerspectiveCamera(90, 16 / 9, 0.1, 100);
  expect(focalOf(projectionMatrix, 1600, 900)).toBeCloseTo(450, 9);
});

test("a photo's lens is wider on a wider canvas", () => {
  const [left, right] = lens(photo, 640, 200);
  expect(right - left).toBeCloseTo(640 / 230, 9);
});
