/** What the page hands over, frame by frame and slider by slider. */

import type { Settings, Viewpoint } from "../types";

/** A slider without a number is no limit; one below zero is zero. */
export function sane(settings: Settings): Settings {
  const limit = (value: number) => (Number.isNaN(value) ? Infinity : Math.max(value, 0));
  const { bytes, gpuBytes, count } = settings.budget;
  return {
    ...settings,
    budget: { bytes: limit(bytes), gpuBytes: limit(gpuBytes), count: limit(count) },
    cacheBytes: limit(settings.cacheBytes),
  };
}

/** Whether nothing moved. */
export function same(a: Viewpoint, b: Viewpoint): boolean {
  const numbers = (v: Viewpoint) => [...v.position, ...v.direction, ...v.frustum.flat()];
  const [x, y] = [numbers(a), numbers(b)];
  return x.length === y.length && x.every((value, i) => value === y[i]);
}
