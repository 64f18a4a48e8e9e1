import { Euler, Quaternion, Vector3 } from "three";
import type { Quat, Vec3 } from "../types";
import { angles, quat, vec3 } from "./frame";

/** A camera in the world (metres, y up) that looks at something `reach` metres ahead. */
export interface Rig {
  readonly position: Vec3;
  readonly yaw: number; // radians
  readonly pitch: number;
  readonly roll: number; // of a photo's pose; the first rotation levels the camera
  readonly reach: number;
}

const STEEPEST = 1.55; // just below vertical, where yaw is undefined
const NEAREST = 0.1; // metres to the orbited point
const FARTHEST = 500;

const clamp = (value: number, low: number, high: number) => Math.min(Math.max(value, low), high);

export function orientation(rig: Rig): Quat {
  return quat(new Quaternion().setFromEuler(new Euler(rig.pitch, rig.yaw, rig.roll, "YXZ")));
}

export function rigAt(position: Vec3, quaternion: Quat, reach: number): Rig {
  return { position, ...angles(quaternion), reach: clamp(reach, NEAREST, FARTHEST) };
}

/** Rotates the camera in place. Angles in radians. */
export function look(rig: Rig, yaw: number, pitch: number): Rig {
  const level = Math.max(0, 1 - 4 * (Math.abs(yaw) + Math.abs(pitch)));
  return {
    ...rig,
    yaw: rig.yaw + yaw,
    pitch: clamp(rig.pitch + pitch, -STEEPEST, STEEPEST),
    roll: rig.roll * level,
  };
}

/** Rotates the camera about the point that it looks at. */
export function orbit(rig: Rig, yaw: number, pitch: number): Rig {
  const target = ahead(rig);
  const turned = look(rig, yaw, pitch);
  const position = target.addScaledVector(forward(turned), -rig.reach);
  return { ...turned, position: vec3(position) };
}

/** Moves along the camera's right, the world's up, and horizontally forward. Metres. */
export function walk(rig: Rig, right: number, up: number, ahead: number): Rig {
  const heading = new Quaternion().setFromEuler(new Euler(0, rig.yaw, 0));
  return shift(rig, new Vector3(right, up, -ahead).applyQuaternion(heading));
}

/** Moves in the image plane. Metres. */
export function pan(rig: Rig, right: number, up: number): Rig {
  return shift(rig, new Vector3(right, up, 0).applyQuaternion(new Quaternion(...orientation(rig))));
}

/** Multiplies the distance to the point that the camera looks at by `factor`. */
export function dolly(rig: Rig, factor: number): Rig {
  const reach = clamp(rig.reach * factor, NEAREST, FARTHEST);
  return { ...shift(rig, forward(rig).multiplyScalar(rig.reach - reach)), reach };
}

/** Interpolates between two poses, t from 0 to 1, along the shorter rotation. */
export function between(from: Rig, to: Rig, t: number): Rig {
  const s = t * t * (3 - 2 * t);
  const mix = (a: number, b: number) => a + (b - a) * s;
  const q = new Quaternion(...orientation(from)).slerp(new Quaternion(...orientation(to)), s);
  const position = new Vector3(...from.position).lerp(new Vector3(...to.position), s);
  return rigAt(vec3(position), quat(q), mix(from.reach, to.reach));
}

/** The direction of view. */
export function forward(rig: Rig): Vector3 {
  return new Vector3(0, 0, -1).applyQuaternion(new Quaternion(...orientation(rig)));
}

function ahead(rig: Rig): Vector3 {
  return new Vector3(...rig.position).addScaledVector(forward(rig), rig.reach);
}

function shift(rig: Rig, by: Vector3): Rig {
  return { ...rig, position: vec3(by.add(new Vector3(...rig.position))) };
}
