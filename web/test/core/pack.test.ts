/** The first load from one stream, and what happens where that is of no use. */

import { describe, expect, test } from "vitest";
import type { StreamerOptions } from "../../src/core/streamer";
import type { Fault } from "../simulate";
import { shown, type World, wanted, world } from "../world";
import { at, NO_BUDGET, type Options, rightOf } from "../worlds";

const PACK = "scene-1.pack";
const made = (options: Options = {}, more: Partial<StreamerOptions> = {}) => {
  const w = world({ labels: 3, levels: 4, pack: true, ...options }, more);
  const { asked } = w.network;
  const chunks = () => asked.filter((path) => path.startsWith("chunks/"));
  const twice = () => asked.filter((path, i) => asked.indexOf(path) < i);
  const file = (label: number, level: number) =>
    w.manifest.labels[label]?.cells[0]?.levels[level - 1]?.uri ?? "";
  return { w, chunks, twice, file };
};

const lowest = ({ manifest }: World) =>
  manifest.labels.flatMap(({ cells }) => cells).reduce((sum, { levels }) => sum + (levels[0]?.bytes ?? 0), 0);

const models = ({ manifest }: World) => manifest.promises.fidelity?.bytes ?? 0;

test("everything comes in few requests, once, and is drawn while it comes", async () => {
  const { w } = made({ levels: 12, bytes: 1500 });
  w.set({ mode: "full" });
  w.streamer.start();
  await w.pass(100 + 15);
  const { count } = w.streamer.state;
  expect(Math.min(...shown(w.streamer.state))).toBeGreaterThan(0);
  expect(count).toBeLessThan(w.manifest.totals.count);
  await w.rest();
  expect(shown(w.streamer.state)).toEqual([12, 12, 12]);
  expect(w.network.asked.length).toBeLessThan(20);
  expect(w.network.aborted).toEqual([]);
  expect(w.streamer.state.bytesLoaded).toBe(w.manifest.totals.bytes + models(w));
  expect(w.streamer.state).toMatchObject({ message: null, pending: 0 });
});

test.each([false, true])(
  "what the plan does not want is not fetched, on no link (ranges: %s)",
  async (streams) => {
    const { w } = made({ levels: 8, streams });
    w.network.bandwidth = 1e9;
    await w.run({ mode: "base" });
    expect(w.streamer.state.bytesLoaded).toBe(lowest(w) + models(w));
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([8, 8, 8]);
    expect(w.streamer.state.bytesLoaded).toBe(w.manifest.totals.bytes + models(w));
    expect(w.network.aborted).toEqual([]);
  },
);

test("the first levels come with the promises, and nothing else before the plan that these make", async () => {
  const { w } = made({ levels: 8 });
  w.network.bandwidth = 50_000;
  w.streamer.start();
  const most = lowest(w) + models(w);
  while (!w.network.finished.includes("promises-1.json")) {
    expect(w.streamer.state.bytesLoaded).toBeLessThanOrEqual(most);
    await w.pass(5);
  }
  await w.rest();
  expect(w.streamer.state.bytesLoaded).toBeGreaterThan(most);
});

describe.each([[[]], [[3, 5]]])("levels that replace: %s", (replaces) => {
  test.each([0.6, 0.75, 0.9])("a target of %f takes at most a tenth more than its plan", async (target) => {
    const { w } = made({ labels: 6, cells: 4, levels: 8, streams: true, replaces });
    w.network.bandwidth = 1e9;
    await w.run({ mode: "target", target });
    const { labels, bytesLoaded } = w.streamer.state;
    expect(shown(w.streamer.state)).toEqual(wanted(w.streamer.state));
    const plan = labels.reduce((sum, { bytes }) => sum + bytes, 0);
    expect(plan).toBeLessThan(0.9 * w.manifest.totals.bytes);
    expect(bytesLoaded - models(w) - lowest(w)).toBeLessThanOrEqual(1.1 * plan);
    expect(w.network.asked.length).toBeLessThan(50);
  });
});

test("a server without ranges sends the pack once, and is asked for no more than what is in sight", async () => {
  const { w, chunks } = made({ labels: 4, levels: 6, streams: true });
  w.network.ranges = false;
  w.streamer.update(rightOf(at(0)));
  await w.run({ mode: "target", target: 0.7, aroundBytes: 1e9 });
  expect(w.network.asked.filter((path) => path === PACK)).toHaveLength(1);
  expect(chunks()).toEqual([]);
  expect(w.streamer.state.bytesLoaded).toBe((w.manifest.pack?.bytes ?? 0) + models(w));
});

test("who is beside another fetches what that one lacks, once, and no pack", async () => {
  const { w } = made({ levels: 8, streams: true });
  await w.run({ mode: "target", target: 0.7 });
  const { bytesLoaded, bytesShown } = w.streamer.state;
  const asked = w.network.asked.length;
  for (let times = 0; times < 2; times++) {
    const other = world({}, { manifest: w.manifest, beside: w.streamer }, w);
    await other.run({ mode: "full" });
    expect(shown(other.streamer.state)).toEqual([8, 8, 8]);
    const more = w.manifest.totals.bytes - bytesShown;
    expect(other.streamer.state.bytesLoaded - models(w)).toBeLessThanOrEqual(times ? 0 : more);
    other.streamer.dispose();
  }
  expect(w.network.asked.slice(asked)).not.toContain(PACK);
  expect(w.streamer.state.bytesLoaded).toBe(bytesLoaded);
});

test("a viewer with a small budget loads little more than that", async () => {
  const { w } = made({ labels: 4, levels: 8 });
  const bytes = w.manifest.totals.bytes / 4;
  await w.run({ mode: "budget", budget: { ...NO_BUDGET, bytes } });
  const models = w.manifest.promises.fidelity?.bytes ?? 0;
  expect(w.streamer.state.bytesShown).toBeLessThanOrEqual(bytes);
  expect(w.streamer.state.bytesLoaded).toBeLessThan(models + w.manifest.totals.bytes / 2);
});

test("dispose ends the stream", async () => {
  const { w } = made();
  w.network.bandwidth = 10_000;
  w.streamer.start();
  await w.pass(150);
  w.streamer.dispose();
  await w.clock.pass(10_000);
  expect(w.network.aborted).toEqual([PACK, "promises-1.json"]);
  expect(w.renderer.alive.size).toBe(0);
  expect(w.network.asked).toEqual([PACK, "promises-1.json"]);
});

test("no room to keep anything: all is drawn all the same", async () => {
  const { w } = made({}, { keepBytes: 0 });
  await w.run({ mode: "full", cacheBytes: 0 });
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  expect(w.streamer.state.bytesLoaded).toBe(w.manifest.totals.bytes + models(w));
});

describe("a pack that fails", () => {
  const NOTE = /scene-1.pack.*; files are loaded one by one.$/;
  test.each<[string, Fault, RegExp | null]>([
    ["missing", 404, null],
    ["refused", 500, null],
    ["offline", "offline", null],
    ["cut in the middle", "cut", null],
    ["without a body", "bodiless", NOTE],
    ["without an answer", "hang", null],
    ["silent in the middle", "stalls", null],
    ["too short", "truncated", NOTE],
    ["too long", "longer", NOTE],
    ["another range", "wrong range", NOTE],
  ])("%s: the rest comes one by one", async (_, fault, note) => {
    const { w, chunks } = made();
    w.network.faults.set(PACK, fault);
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
    if (note) expect(w.streamer.state.message).toMatch(note);
    else expect(w.streamer.state.message).toBeNull();
    expect(new Set(chunks()).size).toBe(chunks().length);
    if (fault === "cut" || fault === "stalls") expect(chunks().length).toBeLessThan(12);
    expect(w.renderer.decoded).toBe(12);
  });

  test("wrong bytes of one increment: fetched by itself", async () => {
    const { w, chunks } = made();
    w.network.faults.set(PACK, ["corrupt"]);
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
    expect(chunks().filter((path) => path.includes("-1-"))).toHaveLength(1);
    expect(new Set(chunks()).size).toBe(chunks().length);
    expect(w.streamer.state.message).toBeNull();
    expect(w.network.aborted).toEqual([]);
  });

  test("wrong there and by itself: capped, and not asked for again", async () => {
    const { w, chunks } = made();
    w.network.faults.set(PACK, ["corrupt"]);
    for (const i of [0, 1, 2]) w.network.faults.set(`chunks/l${i}-1-1.spz`, "corrupt");
    await w.run({ mode: "full" });
    const first = chunks().filter((path) => path.includes("-1-"));
    expect(first).toHaveLength(1);
    expect(w.streamer.state.message).toContain(`${first[0]} is damaged`);
    await w.pass(60_000);
    expect(chunks().filter((path) => path.includes("-1-"))).toEqual(first);
  });

  test("another file in its place: given up after two increments", async () => {
    const { w, chunks, twice } = made();
    w.network.bandwidth = 10_000;
    w.network.files.set(PACK, new Uint8Array(w.manifest.pack?.bytes ?? 0));
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
    expect(chunks()).toHaveLength(12);
    expect(twice()).toEqual([]);
    expect(w.streamer.state.message).toBeNull();
  });

  test("where nothing can be checked, what cannot be decoded is fetched by itself", async () => {
    const { w, chunks, file } = made({}, { digest: null });
    w.renderer.corrupt.add("1/1");
    w.set({ mode: "full" });
    w.streamer.start();
    await w.pass(160);
    w.renderer.corrupt.clear();
    await w.rest();
    expect(chunks()).toContain(file(1, 1));
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  });
});
