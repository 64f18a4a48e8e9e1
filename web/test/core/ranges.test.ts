/** Levels that are ranges of a file: asked for in one request where they touch, checked one by one. */

import { describe, expect, test } from "vitest";
import type { Fetch } from "../../src/core/download";
import type { Fault } from "../simulate";
import { shown, wanted, world } from "../world";
import { NO_BUDGET, type Options } from "../worlds";

const made = (options: Options = {}) => {
  const w = world({ labels: 3, levels: 4, bytes: 4000, streams: true, ...options });
  const file = (label: number) => w.manifest.labels[label]?.cells[0]?.levels[0]?.uri ?? "";
  const asked = (label: number) => w.network.asked.filter((path) => path === file(label)).length;
  const total = w.manifest.totals.bytes + (w.manifest.promises.fidelity?.bytes ?? 0);
  return { w, file, asked, total };
};

test("every level comes once, in fewer requests than levels", async () => {
  const { w, total } = made({ levels: 12, bytes: 3000 });
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([12, 12, 12]);
  expect(w.streamer.state).toMatchObject({ bytesLoaded: total, message: null });
  expect(w.network.askedRanges.length).toBeLessThan(20);
});

test("ranges that come beside others of their file do not wait in the browser's cache", async () => {
  const { w } = made({ labels: 2, cells: 8, levels: 6 });
  const caches = new Map<string, (string | undefined)[]>();
  const fetch: Fetch = (url, init) => {
    if (init?.headers) caches.set(url, [...(caches.get(url) ?? []), init.cache]);
    return w.network.fetch(url, init);
  };
  const other = world({}, { manifest: w.manifest, fetch }, w);
  await other.run({ mode: "base" });
  expect(caches.size).toBe(2);
  for (const all of caches.values()) {
    expect(all[0]).toBeUndefined();
    expect(all).toContain("no-store");
  }
});

test("levels of one request are drawn as they come", async () => {
  const { w } = made({ labels: 1, levels: 12, bytes: 3000 });
  w.set({ mode: "full" });
  w.network.bandwidth = 10_000;
  const seen = new Set<number>();
  w.renderer.watch = () => seen.add(Math.max(0, ...w.renderer.levels(0)));
  await w.run();
  expect(seen.size).toBeGreaterThan(9);
  expect(w.network.askedRanges.length).toBeLessThan(7);
});

test("what the plan does not want is not loaded", async () => {
  const { w } = made({ levels: 12 });
  await w.run({ mode: "base" });
  const lowest = w.manifest.labels.reduce((sum, { cells }) => sum + (cells[0]?.levels[0]?.bytes ?? 0), 0);
  expect(w.streamer.state.bytesLoaded).toBe(lowest + (w.manifest.promises.fidelity?.bytes ?? 0));
  await w.run({ mode: "target", target: 0.7 });
  expect(shown(w.streamer.state)).toEqual(wanted(w.streamer.state));
  const starts = w.network.askedRanges.map((range) => range.replace(/-\d+$/, ""));
  expect(new Set(starts).size).toBe(starts.length);
});

describe("a server without ranges", () => {
  test("sends each file once", async () => {
    const { w, asked, total } = made({ levels: 8 });
    w.network.ranges = false;
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([8, 8, 8]);
    expect([0, 1, 2].map(asked)).toEqual([1, 1, 1]);
    expect(w.streamer.state).toMatchObject({ bytesLoaded: total, message: null });
  });

  test("also where more is wanted later", async () => {
    const { w, asked } = made({ levels: 8 });
    w.network.ranges = false;
    await w.run({ mode: "base" });
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([8, 8, 8]);
    expect([0, 1, 2].map(asked)).toEqual([1, 1, 1]);
  });
});

test.each<[string, Fault[]]>([
  ["no such range", [416]],
  ["another range", ["wrong range"]],
  ["too few bytes", ["truncated"]],
  ["too many bytes", ["longer"]],
  ["wrong bytes", ["corrupt"]],
  ["a broken connection", ["cut", "cut"]],
  ["an error of the server", [500, 503]],
])("%s: tried again, without a word", async (_, faults) => {
  const { w, file } = made();
  w.set({ mode: "full" });
  w.network.faults.set(file(1), [...faults]);
  await w.run();
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  expect(w.streamer.state.message).toBeNull();
});

test.each<[string, Fault, string]>([
  ["no such range", 416, "the server has fewer bytes than the manifest"],
  ["another range", "wrong range", "the server sent bytes 1-"],
  ["too few bytes", "truncated", "only"],
  ["wrong bytes", "corrupt", "its sha-256 is not that of the manifest"],
  ["a missing file", 404, "the server said 404"],
])("%s, always: one line, and the others live on", async (_, fault, words) => {
  const { w, file } = made();
  w.set({ mode: "full" });
  w.network.faults.set(file(1), fault);
  await w.run();
  const { state } = w.streamer;
  expect(shown(state)[1]).toBeLessThan(4);
  expect([shown(state)[0], shown(state)[2]]).toEqual([4, 4]);
  expect(state.message).toContain(words);
  expect(state.message).toContain(file(1));
  expect(state.message).not.toContain("\n");
});

test("an evicted level comes back without being loaded again", async () => {
  const { w } = made({ levels: 6 });
  await w.run({ mode: "full", cacheBytes: 0 });
  const { bytesLoaded } = w.streamer.state;
  const { decoded } = w.renderer;
  await w.run({ mode: "base" });
  expect(w.renderer.alive.size).toBe(3);
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([6, 6, 6]);
  expect(w.streamer.state.bytesLoaded).toBe(bytesLoaded);
  expect(w.renderer.decoded).toBe(decoded + 15);
});

test("with a pack, too", async () => {
  const { w } = made({ levels: 8, pack: true });
  w.network.bandwidth = 100_000;
  w.streamer.start();
  await w.pass(400);
  await w.run({ mode: "budget", budget: { ...NO_BUDGET, bytes: w.manifest.totals.bytes / 3 } });
  const { state } = w.streamer;
  expect(shown(state)).toEqual(wanted(state));
  expect(state.message).toBeNull();
});

test("without promises the pack brings what holds for all viewpoints", async () => {
  const { w } = made({ labels: 6, levels: 16, pack: true });
  w.network.faults.set("promises-1.json", "hang");
  w.set({ mode: "target", target: 0.5 });
  w.network.bandwidth = 200_000;
  w.streamer.start();
  await w.pass(20_000);
  const { state } = w.streamer;
  expect(shown(state)).toEqual(wanted(state));
  const planned = state.labels.reduce((sum, { bytes }) => sum + bytes, 0);
  expect(planned).toBeLessThan(w.manifest.totals.bytes / 2);
  expect(state.bytesLoaded).toBeLessThan(planned + 2 * w.network.bandwidth * 0.1);
});

test("the pack brings nothing that nobody wants", async () => {
  const { w } = made({ labels: 6, levels: 16, pack: true });
  w.network.bandwidth = 200_000;
  await w.run({
    mode: "target",
    target: 0.8,
    weights: new Map([
      [0, 0],
      [1, 0],
      [2, 0],
      [3, 0],
    ]),
  });
  const { state } = w.streamer;
  expect(shown(state)).toEqual(wanted(state));
  const takes = state.labels.reduce(
    (sum, { bytes }) => sum + bytes,
    w.manifest.promises.fidelity?.bytes ?? 0,
  );
  expect(state.bytesLoaded).toBeLessThan(takes + 2 * w.network.bandwidth * 0.1);
  expect(w.network.askedRanges.length).toBeGreaterThan(0);
});
