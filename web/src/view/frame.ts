import { Euler, Matrix4, Quaternion, Vector3 } from "three";
import type { Camera, Manifest, Pose, Quat, Vec3, Viewpoint } from "../types";

/**
 * From the bundle's frame to three's world: metres, y up, the ground at y = 0.
 * A similarity: rotation, one scale, translation.
 */
export function rootMatrix(frame: Manifest["frame"]): Matrix4 {
  const scale = frame.metersPerUnit;
  const rotation = new Quaternion().setFromUnitVectors(
    new Vector3(...frame.up).normalize(),
    new Vector3(0, 1, 0),
  );
  return new Matrix4().compose(
    new Vector3(0, -scale * frame.floor, 0),
    rotation,
    new Vector3(scale, scale, scale),
  );
}

/** A pose transformed by a similarity. */
export function transformPose(pose: Pose, matrix: Matrix4): Pose {
  const rotation = new Quaternion().setFromRotationMatrix(new Matrix4().extractRotation(matrix));
  const position = new Vector3(...pose.position).applyMatrix4(matrix);
  const quaternion = rotation.multiply(new Quaternion(...pose.quaternion)).normalize();
  return { ...pose, position: vec3(position), quaternion: quat(quaternion) };
}

/**
 * The planner's viewpoint, in the bundle's frame.
 * @param root - the bundle's frame to world
 * @param camera - camera to world
 * @param projection - camera to clip space; its near plane is ignored, since near content is visible
 * @param focal - pixels (`focalOf`)
 */
export function viewpoint(root: Matrix4, camera: Matrix4, projection: Matrix4, focal: number): Viewpoint {
  const inverse = root.clone().invert();
  const toBundle = inverse.multiply(camera);
  const direction = new Vector3(0, 0, -1).transformDirection(toBundle);
  const clip = projection.clone().multiply(toBundle.clone().invert()).elements;
  const row = (r: number) => [clip[r], clip[r + 4], clip[r + 8], clip[r + 12]] as number[];
  const w = row(3);
  const planes: [number, number, number, number][] = [];
  for (const axis of [0, 1]) {
    for (const sign of [1, -1]) planes.push(plane(row(axis), w, sign));
  }
  planes.push(behind(toBundle, direction));
  return {
    position: vec3(new Vector3().setFromMatrixPosition(toBundle)),
    direction: vec3(direction),
    frustum: planes,
    lens: [1 / Math.abs(projection.elements[0] || 1), 1 / Math.abs(projection.elements[5] || 1)],
    focal,
  };
}

/** The focal length of a projection onto so many pixels, the geometric mean of both axes'. */
export function focalOf({ elements }: Matrix4, width: number, height: number): number {
  return Math.sqrt(Math.abs((elements[0] ?? 0) * (elements[5] ?? 0)) * width * height) / 2;
}

function plane(axis: number[], w: number[], sign: number): [number, number, number, number] {
  const [x = 0, y = 0, z = 0, d = 0] = w.map((value, i) => value + sign * (axis[i] ?? 0));
  const length = Math.hypot(x, y, z) || 1;
  return [x / length, y / length, z / length, d / length];
}

/** The half space in front of the camera. */
function behind(camera: Matrix4, direction: Vector3): [number, number, number, number] {
  const position = new Vector3().setFromMatrixPosition(camera);
  return [direction.x, direction.y, direction.z, -direction.dot(position)];
}

/**
 * The projection of a photo on a canvas of any size: its height fills the canvas, its principal point and
 * pixel aspect are kept.
 * @returns frustum at distance 1: left, right, top, bottom
 */
export function lens(
  camera: Camera,
  width: number,
  height: number,
): readonly [number, number, number, number] {
  const [fx, fy, cx, cy] = camera.intrinsics;
  const scale = height / camera.height;
  const right = (width / 2 + (camera.width / 2 - cx) * scale) / (fx * scale);
  const left = -(width / 2 - (camera.width / 2 - cx) * scale) / (fx * scale);
  return [left, right, cy / fy, (cy - camera.height) / fy];
}

export const vec3 = (v: Vector3): Vec3 => [v.x, v.y, v.z];
export const quat = (q: Quaternion): Quat => [q.x, q.y, q.z, q.w];

/** Yaw, pitch and roll in radians: turns about y, then x, then z. */
export function angles(q: Quat): { yaw: number; pitch: number; roll: number } {
  const euler = new Euler().setFromQuaternion(new Quaternion(...q), "YXZ");
  return { yaw: euler.y, pitch: euler.x, roll: euler.z };
}
