/** Where a camera may go: not far from where the scene is known, and not through surfaces. */

import { type Matrix4, Vector3 } from "three";
import { Points } from "../core/distance";
import type { Manifest, Promises, Vec3 } from "../types";
import { vec3 } from "./frame";
import { forward, type Rig } from "./motion";

const REACH = 0.25; // of the scene's extent: how far from a known viewpoint one may be
const REACH_OF_PHOTOS = 1; // the same while only those of photos are known
const APPROACH = 0.3; // of the way to the nearest surface that one step closer may take
const CLEARANCE = 0.05; // of the extent: what stays between the camera and a surface
const CONE = 0.7; // cosine of the angle from the view's direction within which surfaces are near
const HALVINGS = 12;

/** The free space that a run knows: around its photos, and the viewpoints in it that promises were tried at. */
export class Bounds {
  isOn = true;
  private viewpoints: readonly Vector3[]; // in the world, metres
  private reach: number;
  private readonly clearance: number;
  private readonly surface: readonly { readonly at: Vector3; readonly radius: number }[];

  /** @param root - from the bundle's frame to the world */
  constructor(
    manifest: Manifest,
    private readonly root: Matrix4,
  ) {
    const { frame, cameras, start, labels } = manifest;
    this.reach = REACH_OF_PHOTOS * frame.extent * frame.metersPerUnit;
    this.clearance = CLEARANCE * frame.extent * frame.metersPerUnit;
    this.viewpoints = [start, ...cameras].map(({ position }) => this.inWorld(position));
    this.surface = labels.flatMap(({ cells }) =>
      cells.flatMap((cell) => {
        const { rows } = new Points(cell);
        return Array.from({ length: rows.length / 4 }, (_, i) => {
          const [x = 0, y = 0, z = 0, area = 0] = rows.subarray(4 * i);
          return { at: this.inWorld([x, y, z]), radius: Math.sqrt(area / Math.PI) * frame.metersPerUnit };
        });
      }),
    );
  }

  /** Adds the viewpoints that promises were tried at. */
  know({ views, extent }: Promises, { extent: all, metersPerUnit }: Manifest["frame"]): void {
    const place: [number, number, number] = [0, 0, 0]; // steps so far
    const added = views[0].map((_, i) => {
      for (const axis of [0, 1, 2] as const) place[axis] += views[axis][i] ?? 0;
      const [x, y, z] = place;
      return this.inWorld([(x / 1e4) * extent, (y / 1e4) * extent, (z / 1e4) * extent]);
    });
    this.viewpoints = [...this.viewpoints, ...added];
    this.reach = REACH * all * metersPerUnit;
  }

  /** How far one gets from one rig towards another: the camera stays where the scene is known, or comes nearer to it. */
  confine(from: Rig, to: Rig): Rig {
    if (!this.isOn) return to;
    const [a, b] = [new Vector3(...from.position), new Vector3(...to.position)];
    const most = Math.max(this.reach, this.away(a));
    if (this.away(b) <= most + 1e-9) return to;
    let [good, bad] = [0, 1];
    for (let i = 0; i < HALVINGS; i++) {
      const t = (good + bad) / 2;
      if (this.away(a.clone().lerp(b, t)) <= most) good = t;
      else bad = t;
    }
    const target = b.clone().addScaledVector(forward(to), to.reach);
    const position = a.lerp(b, good);
    return { ...to, position: vec3(position), reach: Math.max(target.distanceTo(position), 1e-3) };
  }

  /** How far a step closer may go at most, metres: less the nearer a surface is. */
  step(rig: Rig): number {
    if (!this.isOn) return Infinity;
    const ahead = forward(rig);
    const position = new Vector3(...rig.position);
    let nearest = Infinity;
    for (const { at, radius } of this.surface) {
      const to = at.clone().sub(position);
      const distance = to.length();
      if (to.dot(ahead) > CONE * distance) nearest = Math.min(nearest, Math.max(distance - radius, 0));
    }
    return APPROACH * Math.max(nearest - this.clearance, 0);
  }

  private away(position: Vector3): number {
    return Math.min(...this.viewpoints.map((one) => one.distanceTo(position)));
  }

  private inWorld(position: Vec3): Vector3 {
    return new Vector3(...position).applyMatrix4(this.root);
  }
}
