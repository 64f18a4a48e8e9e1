/** Random walks with random changes of settings: what must hold at every moment. */

import { expect, test } from "vitest";
import type { Budget, Settings } from "../../src/types";
import { seeded } from "../simulate";
import { shown, type World, world } from "../world";
import { at, NO_BUDGET, rightOf } from "../worlds";

type Random = () => number;
const pick = <T>(random: Random, of: readonly T[]): T => of[Math.floor(random() * of.length)] as T;

function randomBudget(random: Random, w: World): Budget {
  const { bytes, gpuBytes, count } = w.manifest.totals;
  const part = () => (random() < 0.4 ? Infinity : 0.15 + random());
  return { bytes: part() * bytes, gpuBytes: part() * gpuBytes, count: part() * count };
}

function randomSettings(random: Random, w: World): Partial<Settings> {
  return pick<() => Partial<Settings>>(random, [
    () => ({ mode: pick(random, ["target", "budget", "full", "base"]) }),
    () => ({ target: 0.3 + 0.65 * random() }),
    () => ({ budget: random() < 0.3 ? NO_BUDGET : randomBudget(random, w) }),
    () => ({ weights: new Map([[Math.floor(random() * 5), pick(random, [0, 0.5, 1, 10])]]) }),
    () => ({ cacheBytes: pick(random, [0, 20_000, 1e9]) }),
  ])();
}

const UNITS = ["bytes", "gpuBytes", "count"] as const;

/** What is drawn, by units, and the smallest that could be. */
function drawn(w: World) {
  const files = [...w.renderer.drawn].map((h) => w.manifest.labels[h.label]?.cells[0]?.levels[h.level - 1]);
  const least = w.manifest.labels.map((label) => label.cells[0]?.levels[0]);
  const sum = (of: typeof files, unit: (typeof UNITS)[number]) =>
    of.reduce((all, f) => all + (f?.[unit] ?? 0), 0);
  return UNITS.map((unit) => ({ unit, is: sum(files, unit), least: sum(least, unit) }));
}

/** Decoded increments that are not drawn are within the limit, but for those that are just being swapped. */
function hiddenBytes(w: World): number {
  const hidden = [...w.renderer.alive].filter((handle) => !w.renderer.drawn.has(handle));
  return hidden.reduce(
    (sum, h) => sum + (w.manifest.labels[h.label]?.cells[0]?.levels[h.level - 1]?.gpuBytes ?? 0),
    0,
  );
}

test.each([
  ...[1, 2, 3, 4, 5, 6].map((seed) => ({ seed, pack: false })),
  ...[1, 2, 3, 4, 5, 6].map((seed) => ({ seed, pack: true })),
])("walk $seed: budgets, no holes, limits (pack: $pack)", async ({ seed, pack }) => {
  const random = seeded(seed);
  const w = world({ labels: 5, levels: 5, bytes: 12_000, seed, promises: seed % 3 > 0, pack });
  w.network.bandwidth = pick(random, [250_000, 1e6, 6e6]);
  let x = 0;
  let checked = 0;
  const check = () => {
    const { status } = w.streamer.state;
    for (const { unit, is, least } of drawn(w)) {
      const limit = Math.max(w.settings.budget[unit], status === "over budget" ? least : 0);
      if (is > limit) throw new Error(`${is} ${unit} are drawn, the budget is ${limit}`);
    }
    if (hiddenBytes(w) > w.settings.cacheBytes) throw new Error("more is hidden than the limit allows");
    checked += 1;
  };
  w.streamer.start();
  for (let step = 0; step < 40; step++) {
    x += random() - 0.5;
    w.streamer.update(random() < 0.3 ? rightOf(at(x)) : at(x));
    if (random() < 0.3) w.set(randomSettings(random, w));
    await w.pass(130); // by then the new settings are planned with
    check();
    for (let frame = 0; frame < 3; frame++) {
      await w.pass(random() * 60);
      check();
    }
  }
  await w.rest();
  const { labels, message } = w.streamer.state;
  expect(message).toBeNull();
  for (const label of labels) expect(label.shown).toBe(label.wanted);
  expect(checked).toBeGreaterThan(150);
  // what was given up may be fetched anew, but nothing that had come
  const { finished } = w.network;
  const files = finished.filter((path) => !path.endsWith(".pack"));
  expect(new Set(files).size).toBe(files.length);
  w.streamer.dispose();
  expect(w.renderer.alive.size).toBe(0);
});

test.each([false, true])(
  "a walk over a link that fails one time in four ends well (pack: %s)",
  async (pack) => {
    const random = seeded(11);
    const w = world({ labels: 4, levels: 4, bytes: 8000, seed: 11, pack });
    w.set({ mode: "full" });
    w.streamer.start();
    for (let step = 0; step < 40; step++) {
      if (random() < 0.5) w.network.faults.set("*", pick(random, ["offline", "cut", 503, "hang"] as const));
      else w.network.faults.clear();
      w.streamer.update(at(random()));
      await w.pass(200);
    }
    w.network.faults.clear();
    await w.pass(30_000);
    await w.rest();
    expect(shown(w.streamer.state)).toEqual([4, 4, 4, 4]);
    expect(w.streamer.state.message).toBeNull();
  },
);

test("the same walk twice asks for the same files in the same order", async () => {
  const run = async () => {
    const random = seeded(5);
    const w = world({ labels: 4, levels: 4, bytes: 8000 });
    w.streamer.start();
    for (let step = 0; step < 30; step++) {
      w.streamer.update(at(4 * random()));
      if (random() < 0.3) w.set(randomSettings(random, w));
      await w.pass(150);
    }
    return w.network.asked;
  };
  expect(await run()).toEqual(await run());
});
