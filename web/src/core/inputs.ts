/** Normalises the page's inputs: settings and viewpoints. */

import type { Settings, Viewpoint } from "../types";

/** A budget without a number means no limit; a negative one means zero. */
export function normalised(settings: Settings): Settings {
  const limit = (value: number) => (Number.isNaN(value) ? Infinity : Math.max(value, 0));
  const { bytes, gpuBytes, count } = settings.budget;
  return {
    ...settings,
    budget: { bytes: limit(bytes), gpuBytes: limit(gpuBytes), count: limit(count) },
    cacheBytes: limit(settings.cacheBytes),
    aroundBytes: Math.max(settings.aroundBytes, 0) || 0,
  };
}

/** Whether two viewpoints are equal. */
export function same(a: Viewpoint, b: Viewpoint): boolean {
  const numbers = (v: Viewpoint) => [...v.position, ...v.direction, ...v.frustum.flat(), ...v.lens, v.focal];
  const [x, y] = [numbers(a), numbers(b)];
  return x.length === y.length && x.every((value, i) => value === y[i]);
}
