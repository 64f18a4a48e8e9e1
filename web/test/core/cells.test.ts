/** Cells of labels: what is in sight comes first, what is far and behind holds nothing up, nothing has holes. */

import { expect, test } from "vitest";
import { grouped, summary } from "../../src/ui/groups";
import { judge } from "../network";
import { Network, VirtualClock } from "../simulate";
import { startView, townBundle } from "../town";
import { cellsOf, shown, type World, wanted, world } from "../world";
import { at, DEFAULTS, NO_BUDGET, rightOf } from "../worlds";

const OPTIONS = { side: 3, categories: 4, levels: 5, bytes: 12_000, views: 6 };

function town(bytes = Number.POSITIVE_INFINITY, mode: "full" | "budget" = "full"): World {
  const clock = new VirtualClock();
  const network = new Network(clock);
  const manifest = townBundle(network, OPTIONS);
  const settings = { ...DEFAULTS, mode, budget: { ...NO_BUDGET, bytes } };
  const w = world({}, { manifest, settings, clock, fetch: network.fetch }, { clock, network } as World);
  w.streamer.update(startView());
  return w;
}

test("most of what one sees is there long before everything", async () => {
  const w = town();
  const models = new TextDecoder().decode(w.network.files.get("promises-1.json"));
  const ssim = judge(w.manifest, models);
  const curve: { bytes: number; ssim: number }[] = [];
  let told = 0;
  const check = w.renderer.watch;
  w.renderer.watch = () => {
    check();
    const { bytesLoaded, labels } = w.streamer.state;
    if (bytesLoaded < told) return;
    told = bytesLoaded + 100_000;
    const levels = labels.flatMap(({ cells }) => cells.map((cell) => cell.shown));
    curve.push({ bytes: bytesLoaded, ssim: ssim(startView(), levels) });
  };
  await w.run();
  told = 0;
  w.renderer.watch();
  const last = curve.at(-1)?.ssim ?? 0;
  const most = curve.find((one) => one.ssim >= 0.95 * last)?.bytes ?? Number.POSITIVE_INFINITY;
  expect(cellsOf(w.streamer.state).every(({ shown }) => shown === 5)).toBe(true);
  expect(most).toBeLessThan(0.4 * w.streamer.state.bytesLoaded);
});

test("a budget leaves what is out of sight at its lowest level", async () => {
  const w = town(5e5, "budget");
  await w.run();
  const { state } = w.streamer;
  expect(state.bytesShown).toBeLessThanOrEqual(5e5);
  const cells = cellsOf(state);
  expect(cells.flatMap(({ visible, shown }) => (visible ? [] : shown)).filter((k) => k !== 1)).toEqual([]);
  expect(cells.some(({ visible, shown }) => visible && shown > 1)).toBe(true);
});

test("where not even the lowest levels fit, cells out of sight are left out, the least first", async () => {
  const w = town();
  const all = w.manifest.labels.flatMap((label) => label.cells);
  const base = all.reduce((sum, cell) => sum + (cell.levels[0]?.bytes ?? 0), 0);
  await w.run({ mode: "budget", budget: { ...NO_BUDGET, bytes: 0.9 * base } });
  const { state } = w.streamer;
  expect(state.status).toBe("ok");
  expect(state.bytesShown).toBeLessThanOrEqual(0.9 * base);
  const cells = cellsOf(state);
  expect(cells.some(({ shown }) => !shown)).toBe(true);
  expect(cells.filter(({ visible }) => visible).every(({ shown }) => shown > 0)).toBe(true);
});

test("cells of one label have levels of their own, and the label keeps its target", async () => {
  const w = town();
  await w.run({ mode: "target", target: 0.72 });
  const { state } = w.streamer;
  expect(state.status).toBe("ok");
  for (const { cells, promised, visible, wanted: planned, shown: drawn } of state.labels) {
    const seen = cells.filter((cell) => cell.visible);
    expect(visible).toBe(seen.length > 0);
    expect(drawn).toBe(planned);
    expect(promised).toBeGreaterThanOrEqual(0.72 - 1e-9);
    expect(cells.every((cell) => cell.visible || cell.shown === 1)).toBe(true);
    expect(new Set(seen.map((cell) => cell.shown)).size).toBeGreaterThan(1);
  }
});

test("what the head may turn to is raised once everything in sight is drawn", async () => {
  const w = town();
  w.streamer.update(startView());
  const aroundBytes = 0.05 * w.manifest.totals.bytes;
  const early: string[] = [];
  w.renderer.watch = () => {
    const cells = cellsOf(w.streamer.state);
    const isDrawn = cells.every(({ visible, shown, wanted }) => !visible || shown >= wanted);
    if (!isDrawn && cells.some(({ visible, shown }) => !visible && shown > 1)) early.push("raised");
  };
  await w.run({ mode: "target", target: 0.8 });
  const plain = w.streamer.state;
  await w.run({ aroundBytes });
  const raised = w.streamer.state;
  expect(early).toEqual([]);
  const levels = (seen: boolean, of: typeof plain) =>
    cellsOf(of).flatMap(({ visible, shown }) => (visible === seen ? shown : []));
  expect(levels(true, raised)).toEqual(levels(true, plain));
  expect(Math.max(...levels(false, raised))).toBeGreaterThan(1);
  expect(raised.bytesShown - plain.bytesShown).toBeLessThanOrEqual(aroundBytes);
  expect(raised.bytesShown - plain.bytesShown).toBeGreaterThan(0.5 * aroundBytes);
});

test("first levels come before all else, those in sight first", async () => {
  const w = town();
  await w.run({ mode: "target", target: 0.8 });
  const asked = w.network.asked.filter((path) => path.startsWith("chunks/"));
  const first = asked.findIndex((path) => !path.endsWith("-1.spz"));
  const visible = new Set(
    cellsOf(w.streamer.state).flatMap(({ cell, visible }) => (visible ? cell.levels[0]?.uri : [])),
  );
  expect(new Set(asked.slice(0, visible.size))).toEqual(visible);
  expect(first).toBeGreaterThanOrEqual(visible.size);
});

test.each([false, true])(
  "nothing is ever missing while one turns and walks (streams: %s)",
  async (streams) => {
    const w = world({ labels: 3, cells: 3, levels: 5, bytes: 8000, streams, pack: streams });
    w.network.bandwidth = 60_000;
    w.set({ target: 0.8, cacheBytes: 20_000, aroundBytes: 15_000 });
    w.streamer.start();
    while (shown(w.streamer.state).some((level) => !level)) await w.pass(50);
    for (let step = 0; step < 60; step++) {
      const view = at(3 * Math.sin(step / 5));
      w.streamer.update(step % 7 < 3 ? rightOf(view) : view);
      if (step === 30) w.set({ target: 0.88 });
      await w.pass(90); // the watcher looks for holes and half swaps
      for (const { visible, shown } of cellsOf(w.streamer.state))
        if (visible) expect(shown).toBeGreaterThan(0);
    }
    w.streamer.update(at(0));
    await w.rest();
    expect(shown(w.streamer.state)).toEqual(wanted(w.streamer.state));
  },
);

test("a level of a cell that replaces those below changes in one swap, whatever its neighbours do", async () => {
  const w = world({ labels: 1, cells: 3, levels: 5, replaces: [3] });
  await w.run({ mode: "base" });
  w.renderer.swaps = [];
  await w.run({ mode: "full" });
  const changes = w.renderer.swaps.filter(({ hide }) => hide.length);
  for (const { show, hide } of changes) {
    for (const { cell } of hide) expect(show.some((handle) => handle.cell === cell)).toBe(true);
  }
  expect(changes.flatMap(({ hide }) => hide.map(({ cell }) => cell)).sort()).toEqual([0, 1, 2]);
});

test("a damaged level caps its cell alone", async () => {
  const w = world({ labels: 2, cells: 2, levels: 4 });
  w.renderer.corrupt.add("1/3");
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([4, 2, 4, 4]);
  expect(w.streamer.state.message).toContain("a part of label 0 stays at level 2");
});

test("a label's settings are those of all its cells", async () => {
  const w = world({ labels: 2, cells: 2, levels: 4 });
  await w.run({ target: 0.8, weights: new Map([[0, 0]]) });
  expect(shown(w.streamer.state).slice(0, 2)).toEqual([1, 1]);
  expect(Math.min(...shown(w.streamer.state).slice(2))).toBeGreaterThan(1);
  await w.run({ always: new Map([[0, true]]) });
  expect(shown(w.streamer.state).slice(0, 2)).toEqual([4, 4]);
  expect(w.streamer.state.labels[0]).toMatchObject({ shown: 1, wanted: 1 });
});

test("rows sum up what a label has in sight, and instances stay with their parent", async () => {
  const made = world({ labels: 4, cells: 2, levels: 4 });
  const labels = made.manifest.labels.map((label, i) => (i < 2 ? { ...label, parent: "chair" } : label));
  const w = world({}, { manifest: { ...made.manifest, labels } }, made);
  w.streamer.start();
  w.set({ mode: "full" });
  w.streamer.update(rightOf(at(0)));
  await made.pass(5000);
  const groups = grouped(w.streamer.state.labels);
  expect(groups.map(({ title }) => title).sort()).toEqual(["chair", "label 2", "label 3"]);
  const chair = groups.find(({ key }) => key === "chair");
  expect(chair?.states).toHaveLength(2);
  expect(summary(chair?.states ?? [])).toMatchObject({ visible: false, shown: 1, wanted: 1, missing: false });
  const half = groups.find(({ title }) => title === "label 2"); // from x = -1 to 1
  const [state] = half?.states ?? [];
  expect(state?.cells.filter(({ visible }) => visible)).toHaveLength(2);
  expect(summary(half?.states ?? []).bytes).toBe(state?.bytes);
});
