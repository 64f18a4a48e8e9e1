/** Which cells are drawn, and their colours. */

import { expect, test } from "vitest";
import type { Box, Viewpoint } from "../../src/types";
import { colorsOf } from "../../src/view/colors";
import { boundsOf, type Drawable, drawnCells, joinedBounds, touches } from "../../src/view/culling";
import { ENCODING } from "../../src/view/packing";
import { Network, VirtualClock } from "../simulate";
import { bundle, frustumOf, lensOf } from "../worlds";

const FOV = 1; // radians, of a square picture

/** At the origin, turned to the left by an angle; -z is ahead. */
const turned = (angle: number): Viewpoint => ({
  position: [0, 0, 0],
  direction: [-Math.sin(angle), 0, -Math.cos(angle)],
  frustum: frustumOf([0, 0, 0], [0, Math.sin(angle / 2), 0, Math.cos(angle / 2)], FOV, 1),
  lens: lensOf(FOV, 1),
});

/** A small cell at a distance of 10, so many radians to the right. */
const at = (angle: number, drawn: boolean, count = 100): Drawable => {
  const [x, z] = [10 * Math.sin(angle), -10 * Math.cos(angle)];
  return { bounds: [x - 0.01, -0.01, z - 0.01, x + 0.01, 0.01, z + 0.01], count, drawn };
};

test("a cell is drawn before it comes into sight, and left out when it is far from it", () => {
  const cells = (drawn: boolean) => [0, 0.45, 0.6, 0.8, 1.5, Math.PI].map((angle) => at(angle, drawn));
  expect(drawnCells(cells(false), turned(0))).toEqual([true, true, true, true, false, false]);
  expect(drawnCells(cells(true), turned(0))).toEqual([true, true, true, true, false, false]);
});

test("another set of cells is drawn as seldom as can be", () => {
  const near = [at(0, true), at(0.8, false), at(1.5, false)]; // 0.8 may be drawn, but need not be
  expect(drawnCells(near, turned(0))).toEqual([true, false, false]);
  expect(drawnCells([...near, at(0.6, false)], turned(0))).toEqual([true, true, false, true]);
  const few = [at(0, true), at(2, true, 10)]; // hardly any waste
  expect(drawnCells(few, turned(0))).toEqual([true, true]);
  expect(drawnCells([at(0, true), at(2, true, 90)], turned(0))).toEqual([true, false]);
});

test("what has no splats yet is drawn, so that it appears as soon as it has", () => {
  const empty = { bounds: null, count: 0, drawn: true };
  expect(drawnCells([empty, at(2, true)], turned(0))).toEqual([true, false]);
});

test("while one turns, nothing in sight is ever left out", () => {
  const around = Array.from({ length: 40 }, (_, i) => (i * Math.PI) / 20);
  let drawn = around.map(() => false);
  let changes = 0;
  for (let step = 0; step < 200; step++) {
    const view = turned(0.05 * step);
    const cells = around.map((angle, i) => at(-angle, drawn[i] ?? true));
    const next = drawnCells(cells, view);
    cells.forEach(({ bounds }, i) => {
      if (touches(bounds as Box, view.frustum)) expect(next[i]).toBe(true);
    });
    if (next.join() !== drawn.join()) changes += 1;
    drawn = next;
    expect(drawn.filter((is) => is).length).toBeLessThan(20);
  }
  expect(changes).toBeLessThan(80);
});

test("a frustum wider than a half space leaves out nothing in front", () => {
  const wide = { ...turned(0), frustum: frustumOf([0, 0, 0], [0, 0, 0, 1], 2.8, 1) };
  expect(drawnCells([at(1.5, false), at(3, false)], wide)).toEqual([true, false]);
  expect(drawnCells([at(3, false)], { ...wide, frustum: [] })).toEqual([true]);
});

test("bounds reach as far as splats are drawn", () => {
  const one = 0x3c00; // 1 as a half
  const steps = 1 + Math.round(((Math.log(0.1) + 12) * 254) / 21);
  const words = Uint32Array.from([0, one | (one << 16), one, steps | (1 << 8), 0, 0, 0, 0]);
  const box = boundsOf(words, 2, ENCODING);
  const reach = 3.33 * Math.exp(-12 + ((steps - 1) * 21) / 254);
  expect(box?.slice(3)).toEqual([1, 1, 1].map(() => expect.closeTo(1 + reach, 9)));
  expect(box?.slice(0, 3)).toEqual([0, 0, 0].map(() => expect.closeTo(0, 4)));
  expect(boundsOf(words, 0, ENCODING)).toBeNull();
  expect(joinedBounds(null, [0, 0, 0, 1, 1, 1])).toEqual([0, 0, 0, 1, 1, 1]);
  expect(joinedBounds([0, -1, 0, 1, 1, 1], [-1, 0, 0, 0, 2, 1])).toEqual([-1, -1, 0, 1, 2, 1]);
});

test("cells have the colours of their labels, or shades of them that differ", () => {
  const { labels, ...rest } = bundle(new Network(new VirtualClock()), { labels: 2, cells: 4 });
  const manifest = { ...rest, labels: labels.map((label) => ({ ...label, color: "#4080c0" })) };
  expect(new Set(colorsOf(manifest).values())).toEqual(new Set(["#4080c0"]));
  const shades = [...colorsOf(manifest, true).values()];
  expect(shades).toHaveLength(8);
  expect(shades[0]).toBe("#4080c0");
  expect(new Set(shades.slice(0, 4)).size).toBe(4);
  for (const shade of shades) {
    const [r = 0, g = 0, b = 0] = [1, 3, 5].map((i) => Number.parseInt(shade.slice(i, i + 2), 16));
    expect(r < g && g < b).toBe(true); // the label's hue
  }
});
