import { expect, test } from "vitest";
import { type Governor, governor, next, XR_SPLATS } from "../../src/view/governor";

const WANTED = 1000 / 72;

/** Frames of `cost` ms a splat, at least the headset's own. */
function run(start: Governor, seconds: number, cost: number, most = XR_SPLATS): Governor[] {
  const all = [start];
  let [g, now] = [start, start.changed];
  while (now < start.changed + seconds * 1000) {
    const frame = Math.max(WANTED, cost * g.cap);
    now += frame;
    g = next(g, frame, WANTED, now, most, g.cap);
    all.push(g);
  }
  return all;
}

test("it begins with what headsets hold, or less", () => {
  expect(governor(2e6, 0).cap).toBe(XR_SPLATS);
  expect(governor(1e5, 0).cap).toBe(1e5);
});

test("late frames lower the count until they are on time", () => {
  const cost = WANTED / 200_000;
  const g = run(governor(XR_SPLATS, 0), 10, cost).at(-1) as Governor;
  expect(g.cap).toBeLessThan(240_000);
  expect(g.cap).toBeGreaterThan(100_000);
});

test("it never falls to nothing", () => {
  expect((run(governor(XR_SPLATS, 0), 60, 0.002).at(-1) as Governor).cap).toBe(20_000);
});

test("frames on time raise it slowly, never above what the user allows", () => {
  const low = governor(50_000, 0);
  const after = run(low, 9, 0).map(({ cap }) => cap);
  expect(Math.max(...after)).toBeLessThan(70_000);
  expect((run(low, 600, 0, 80_000).at(-1) as Governor).cap).toBe(80_000);
});

test("a limit that is not reached is not raised", () => {
  let g = governor(50_000, 0);
  for (let now = 0; now < 60_000; now += WANTED) g = next(g, WANTED, WANTED, now, XR_SPLATS, 10_000);
  expect(g.cap).toBe(50_000);
});

test("it tries less and less often what was too much", () => {
  const caps = run(governor(XR_SPLATS, 0), 240, WANTED / 100_000);
  const patience = caps.map((g) => g.patience);
  expect(patience.at(-1)).toBeGreaterThan(patience[0] ?? 0);
});
