import { expect, test } from "vitest";
import { backToFront } from "../../src/core/sort";

test("splats come from the farthest to the nearest, of equal ones the earlier first", () => {
  const depths = Float32Array.from([2, Infinity, 0, 7.5, 2, 1e-30, 7.500001, 2, 3e38, Infinity]);
  const ordering = new Uint32Array(depths.length);
  const count = backToFront(9, new Uint32Array(depths.buffer), ordering);
  expect([...ordering.subarray(0, count)]).toEqual([8, 6, 3, 0, 4, 7, 5, 2]);
});

test("many splats", () => {
  const depths = Float32Array.from({ length: 100_000 }, (_, i) => ((i * 48271) % 65_521) / 7);
  const ordering = new Uint32Array(depths.length);
  expect(backToFront(depths.length, new Uint32Array(depths.buffer), ordering)).toBe(depths.length);
  for (let i = 1; i < ordering.length; i++) {
    const [a = 0, b = 0] = ordering.subarray(i - 1, i + 1);
    const [far = 0, near = 0] = [depths[a], depths[b]];
    if (!(far > near || (far === near && a < b))) throw new Error(`${i}: ${a} at ${far}, ${b} at ${near}`);
  }
});
