/** Levels that replace those below: no hole, nothing drawn twice, nothing fetched in vain, nothing kept too long. */

import { expect, test } from "vitest";
import { steps } from "../../src/core/order";
import { ladderOf, makePlan } from "../../src/core/planner";
import { Entry } from "../../src/core/residency";
import { Network, seeded, VirtualClock } from "../simulate";
import { shown, type World, wanted, world } from "../world";
import { at, bundle, NO_BUDGET, rightOf } from "../worlds";

const OPTIONS = { labels: 3, levels: 5, replaces: [4] };
const levelsAsked = (w: World, label: number) =>
  w.network.asked.flatMap((path) => {
    const found = path.match(`^chunks/l${label}-(\\d)`);
    return found ? Number(found[1]) : [];
  });

async function started(mode: "base" | "full" | "target", options = {}, more = {}): Promise<World> {
  const w = world({ ...OPTIONS, ...options }, more);
  await w.run({ mode });
  return w;
}

test("a level costs what it holds", () => {
  const cell = bundle(new Network(new VirtualClock()), { ...OPTIONS, replaces: [2, 4] }).labels[0]?.cells[0];
  if (!cell) throw new Error("no cell");
  const [a = 0, b = 0, c = 0, d = 0, e = 0] = cell.levels.map(({ bytes }) => bytes);
  expect(ladderOf(cell).bytes).toEqual([a, b, b + c, d, d + e]);
  expect(ladderOf(cell, 7).bytes).toEqual([a, b, b + c, d + 7, d + e + 7]); // its part of a palette
});

test("what is there costs a quarter of its bytes, a palette's part included", () => {
  const [label] = bundle(new Network(new VirtualClock()), {
    ...OPTIONS,
    labels: 1,
    streams: true,
    replaces: [3],
    palette: 40,
  }).labels;
  const [cell] = label?.cells ?? [];
  if (!label || !cell) throw new Error("no cell");
  const entry = new Entry(label, cell);
  const [a = 0, b = 0, c = 0, d = 0, e = 0] = cell.levels.map(({ bytes }) => bytes);
  expect(entry.effort(() => false)).toEqual(entry.ladder.bytes);
  expect(entry.effort((file) => file === cell.levels[0] || file === cell.levels[2])).toEqual([
    0.25 * a,
    0.25 * a + b,
    0.25 * c + 40,
    0.25 * c + d + 40,
    0.25 * c + d + e + 40,
  ]);
  expect(entry.effort(() => true)).toEqual(entry.ladder.bytes.map((bytes) => 0.25 * bytes));
});

test("above a level that replaces, the first comes first, and those between are never fetched", async () => {
  const w = await started("full");
  expect(shown(w.streamer.state)).toEqual([5, 5, 5]);
  for (const label of [0, 1, 2]) {
    expect(levelsAsked(w, label)).toEqual([1, 4, 5]);
    expect(w.renderer.levels(label)).toEqual([4, 5]);
  }
  const { count, bytesShown, gpuBytes } = w.streamer.state;
  expect([count, bytesShown]).toEqual([w.manifest.totals.count, w.manifest.totals.bytes]);
  expect(gpuBytes).toBe(w.manifest.totals.gpuBytes); // without the first level
  expect(w.renderer.alive.size).toBe(3 * 3); // which stays in memory, for the way back
});

test("what is shown in full for a while is as before afterwards, also on the GPU", async () => {
  const w = await started("target", { replaces: [5] });
  const { count, bytesShown, gpuBytes } = w.streamer.state;
  expect(count).toBeLessThan(w.manifest.totals.count);
  await w.run({ always: new Map(w.manifest.labels.map(({ id }) => [id, true])) }); // labels are edited
  expect(w.streamer.state.count).toBe(w.manifest.totals.count);
  expect(w.streamer.state.gpuBytes).toBe(w.manifest.totals.gpuBytes);
  await w.run({ always: new Map() });
  expect(w.streamer.state).toMatchObject({ count, bytesShown, gpuBytes });
});

test("a stream that replaces those below needs nothing of theirs", async () => {
  const w = await started("full", { labels: 1, streams: true, cells: 2, replaces: [2, 4] });
  expect(shown(w.streamer.state)).toEqual([5, 5]);
  expect(w.renderer.decoded).toBe(2 * 3); // the first level, and those of the last stream
  await w.run({ mode: "base" });
  expect(shown(w.streamer.state)).toEqual([1, 1]);
});

const GIVEN = { labels: 2, streams: true, cells: 2, replaces: [3], palette: 3000 };
test.each([
  ["ranges", {}],
  ["a pack", { pack: true }],
])("streams are decoded with the palette of their file, with %s", async (_name, more) => {
  const w = await started("full", { ...GIVEN, ...more });
  expect(shown(w.streamer.state)).toEqual([5, 5, 5, 5]);
  await w.run({ mode: "base" });
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([5, 5, 5, 5]);
  expect(w.streamer.state.message).toBe(null);
});

test("what an earlier visit kept is not asked for again, palettes included", async () => {
  const first = await started("full", GIVEN);
  const w = world(GIVEN);
  w.streamer.know(new Map(first.streamer.contents));
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([5, 5, 5, 5]);
  expect(w.streamer.state.bytesLoaded).toBe(w.manifest.promises.fidelity?.bytes ?? 0);
});

test("below the levels that need it no palette is asked for", async () => {
  const w = await started("base", GIVEN);
  expect(shown(w.streamer.state)).toEqual([1, 1, 1, 1]);
  const bytes = w.manifest.labels.flatMap(({ cells }) => cells.map(({ levels }) => levels[0]?.bytes ?? 0));
  const models = w.manifest.promises.fidelity?.bytes ?? 0;
  expect(w.streamer.state.bytesLoaded).toBe(bytes.reduce((sum, one) => sum + one, models));
});

test("a palette that is damaged for good leaves the levels below", async () => {
  const w = world({ ...GIVEN, labels: 1 });
  const palette = w.manifest.labels[0]?.palette;
  const content = w.network.files.get(palette?.uri ?? "");
  if (!content) throw new Error("no palette");
  content[7] = (content[7] as number) ^ 1;
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([2, 2]);
  expect(w.streamer.state.message).toContain("damaged");
});

test("below it levels add up as ever", async () => {
  const w = await started("base", { labels: 1 });
  expect(shown(w.streamer.state)).toEqual([1]);
  const third = ladderOf(w.manifest.labels[0]?.cells[0] as never).count[2] ?? 0;
  await w.run({ mode: "budget", budget: { ...NO_BUDGET, count: third } });
  const level = wanted(w.streamer.state)[0] ?? 0;
  expect(level).toBeLessThan(4);
  expect(w.streamer.state.count).toBe(ladderOf(w.manifest.labels[0]?.cells[0] as never).count[level - 1]);
});

test("the old and the new change places in one swap, up and down", async () => {
  const w = await started("base", { labels: 1 });
  w.renderer.swaps = [];
  await w.run({ mode: "full" });
  expect(w.renderer.swaps.map(({ show, hide }) => [show, hide].map((l) => l.map((h) => h.level)))).toEqual([
    [[4], [1]],
    [[5], []],
  ]);
  w.renderer.swaps = [];
  await w.run({ mode: "base" });
  expect(w.renderer.swaps.map(({ show, hide }) => [show, hide].map((l) => l.map((h) => h.level)))).toEqual([
    [[1], [4, 5]],
  ]);
});

test("on the way down the upper level stays until the whole lower one is there", async () => {
  const w = await started("full", { labels: 1, bytes: 100_000 });
  const third = ladderOf(w.manifest.labels[0]?.cells[0] as never).count[2] ?? 0;
  w.set({ cacheBytes: 0 });
  w.renderer.swaps = [];
  w.set({ budget: { ...NO_BUDGET, count: third } });
  await w.pass(150);
  expect(wanted(w.streamer.state)).toEqual([3]);
  expect(shown(w.streamer.state)).toEqual([5]);
  await w.rest();
  expect(shown(w.streamer.state)).toEqual([3]);
  expect(w.renderer.swaps).toHaveLength(1);
  expect(w.renderer.alive.size).toBe(3);
});

test("who changes his mind on the way down leaves nothing in memory", async () => {
  const w = await started("full", { labels: 1, bytes: 100_000 });
  const third = ladderOf(w.manifest.labels[0]?.cells[0] as never).count[2] ?? 0;
  w.set({ cacheBytes: 0 });
  w.network.bandwidth = 1e5;
  w.set({ budget: { ...NO_BUDGET, count: third } });
  while (w.renderer.alive.size < 3) await w.pass(50);
  expect(shown(w.streamer.state)).toEqual([5]);
  await w.run({ budget: NO_BUDGET });
  expect(shown(w.streamer.state)).toEqual([5]);
  expect(w.renderer.alive.size).toBe(2);
});

test("a damaged level below one that replaces is as if there were no higher ones", async () => {
  const w = world({ ...OPTIONS, labels: 1 });
  w.renderer.corrupt.add("0/4");
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([3]);
  expect(w.streamer.state.message).toContain("stays at level 3");
});

test("a pack brings them too, and the rest of it is not waited for", async () => {
  const w = await started("full", { pack: true });
  expect(shown(w.streamer.state)).toEqual([5, 5, 5]);
  await w.run({ mode: "base" });
  expect(shown(w.streamer.state)).toEqual([1, 1, 1]);
});

test("its gain is that over what is shown, for all of its bytes", () => {
  const cell = bundle(new Network(new VirtualClock()), OPTIONS).labels[0]?.cells[0];
  if (!cell) throw new Error("no cell");
  const c = {
    ladder: ladderOf(cell),
    effort: ladderOf(cell).bytes,
    highest: 5,
    mean: [0.4, 0.5, 0.6, 0.9, 0.95],
    weight: 1,
    always: false,
    share: 1,
    potential: 1,
    visible: true,
    previous: 0,
  };
  const [, , , fourth = 1] = cell.levels.map(({ bytes }) => bytes);
  const [first, second] = steps(c, cell.levels, [4, 5], 0, 1, 3);
  expect(first).toEqual({ level: 4, value: expect.closeTo(0.3 / fourth, 9) });
  expect(second?.level).toBe(5);
  expect(steps(c, cell.levels, [1, 4, 5], 1, 1)[0]).toEqual({
    level: 4,
    value: expect.closeTo(0.5 / fourth, 9),
  });
  const settings = { ...world().settings, mode: "budget" as const };
  const budget = { ...NO_BUDGET, bytes: fourth };
  expect(makePlan([{ cells: [c], needed: 0.9 }], { ...settings, budget }).wanted).toEqual([[4]]);
});

test.each([1, 2, 3, 4, 5, 6])("a walk at random %i", async (seed) => {
  const random = seeded(seed);
  const w = await started("target", { labels: 4, levels: 6, replaces: seed % 2 ? [3, 5] : [4], seed });
  w.network.bandwidth = 3e5;
  for (let step = 0; step < 40; step++) {
    const count = random() < 0.5 ? Infinity : w.manifest.totals.count * random() * 1.2;
    const mode = (["base", "full", "target", "budget"] as const)[Math.floor(4 * random())] ?? "full";
    w.set({
      mode,
      target: 0.5 + 0.5 * random(),
      budget: { ...NO_BUDGET, count },
      cacheBytes: random() < 0.5 ? 0 : 1e6,
    });
    const view = at(4 * random() - 2);
    w.streamer.update(random() < 0.3 ? rightOf(view) : view);
    await w.pass(600 * random());
  }
  w.set({ mode: "full", budget: NO_BUDGET, cacheBytes: 0 });
  w.streamer.update(at(0));
  await w.rest();
  expect(shown(w.streamer.state)).toEqual([6, 6, 6, 6]);
  expect(w.streamer.state.gpuBytes).toBe(w.manifest.totals.gpuBytes);
  w.streamer.dispose();
  expect(w.renderer.alive.size).toBe(0);
});
