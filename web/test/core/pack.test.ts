/** The first load from one stream, and what happens where that is of no use. */

import { describe, expect, test } from "vitest";
import type { StreamerOptions } from "../../src/core/streamer";
import type { Fault } from "../simulate";
import { shown, world } from "../world";
import { NO_BUDGET, type Options } from "../worlds";

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

test("everything comes from one stream, and is drawn while it comes", async () => {
  const { w, chunks } = made();
  w.set({ mode: "full" });
  w.streamer.start();
  await w.pass(100 + 75);
  const { count } = w.streamer.state;
  expect(Math.min(...shown(w.streamer.state))).toBeGreaterThan(0);
  expect(count).toBeLessThan(w.manifest.totals.count);
  await w.rest();
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  expect(chunks()).toEqual([]);
  expect(w.network.asked).toEqual([PACK, "promises-1.json"]); // the plan does not need them
  expect(w.network.aborted).toEqual([]);
  const { pack, promises } = w.manifest;
  expect(w.streamer.state.bytesLoaded).toBe((pack?.bytes ?? 0) + (promises.fidelity?.bytes ?? 0));
  expect(w.streamer.state).toMatchObject({ message: null, pending: 0 });
});

test("a plan that wants less stops the stream, and what came is kept", async () => {
  const { w, chunks } = made({ levels: 8 });
  w.network.bandwidth = 250_000;
  await w.run({ mode: "base" });
  expect(w.network.aborted).toEqual([PACK]);
  expect(w.network.asked).toEqual([PACK, "promises-1.json"]);
  expect(w.streamer.state.bytesLoaded).toBeLessThan(w.manifest.totals.bytes / 4);
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([8, 8, 8]);
  expect(new Set(chunks()).size).toBe(chunks().length);
  expect(w.network.asked.filter((path) => path === PACK)).toHaveLength(1);
  for (const label of [0, 1, 2]) expect(chunks()).not.toContain(`chunks/l${label}-1-1.spz`);
});

test("the stream goes on while the promises may still want more", async () => {
  const { w } = made({ levels: 8 });
  w.network.bandwidth = 250_000;
  w.streamer.start();
  const asked = () => w.network.asked.includes("promises-1.json");
  while (!asked()) await w.pass(10);
  await w.pass(10);
  expect(Math.min(...shown(w.streamer.state))).toBeGreaterThan(0); // first the smallest of all
  while (!w.network.finished.includes("promises-1.json")) {
    expect(w.network.aborted).toEqual([]);
    await w.pass(10);
  }
  await w.rest();
  expect(w.network.finished.length + w.network.aborted.length).toBe(new Set(w.network.asked).size);
});

test("what the stream would bring late is fetched beside it", async () => {
  const { w, chunks, twice, file } = made({ labels: 6, levels: 6 });
  w.network.bandwidth = 250_000;
  w.set({ mode: "target", target: 0.5 });
  w.streamer.start();
  while (!w.network.finished.includes("promises-1.json")) await w.pass(10);
  expect(chunks()).toEqual([]);
  // one label alone is worth anything: it lies all over the pack
  w.set({ mode: "target", target: 0.95, weights: new Map([0, 1, 2, 3, 4].map((id) => [id, 0])) });
  await w.pass(1000);
  expect(chunks()).toContain(file(5, 6));
  expect(chunks().every((path) => path.startsWith("chunks/l5-"))).toBe(true);
  expect(w.network.asked[0]).toBe(PACK);
  await w.rest();
  expect(w.network.aborted).toEqual([PACK]);
  expect(shown(w.streamer.state)[5]).toBeGreaterThan(4);
  expect(twice()).toEqual([]);
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
  expect(w.network.asked).toEqual([PACK, "promises-1.json"]);
});

describe("a stream that fails", () => {
  test.each<[string, Fault, RegExp | null]>([
    ["missing", 404, null],
    ["refused", 500, null],
    ["offline", "offline", null],
    ["cut in the middle", "cut", null],
    ["without a body", "bodiless", null],
    ["without an answer", "hang", null],
    ["silent in the middle", "stalls", null],
    [
      "too short",
      "truncated",
      /^scene-1.pack is damaged: only \d+ of \d+ bytes; files are loaded one by one.$/,
    ],
    ["too long", "longer", /^scene-1.pack is damaged: more than \d+ bytes; files are loaded one by one.$/],
  ])("%s: the rest comes one by one", async (_, fault, note) => {
    const { w, chunks, twice } = made();
    w.network.faults.set(PACK, fault);
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
    if (note) expect(w.streamer.state.message).toMatch(note);
    else expect(w.streamer.state.message).toBeNull();
    expect(twice()).toEqual([]);
    if (fault === "cut" || fault === "stalls") expect(chunks().length).toBeLessThan(8);
    expect(w.renderer.decoded).toBe(12);
  });

  test("another length in the answer's head: nothing of it is taken", async () => {
    const { w, chunks } = made();
    const { fetch } = w.network;
    const shorter: typeof fetch = async (url, init) => {
      const reply = await fetch(url, init);
      if (!url.endsWith(PACK)) return reply;
      return { ...reply, headers: { get: (name) => (name === "Content-Length" ? "99" : null) } };
    };
    const other = world({}, { manifest: w.manifest, fetch: shorter }, w);
    await other.run({ mode: "full" });
    expect(chunks()).toHaveLength(12);
    expect(other.streamer.state.message).toContain("only 99 of");
  });

  test("wrong bytes of one increment: fetched by itself", async () => {
    const { w, chunks, file } = made();
    w.network.faults.set(PACK, "corrupt");
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
    expect(chunks()).toHaveLength(1);
    expect([1, 2, 3, 4].flatMap((level) => [0, 1, 2].map((i) => file(i, level)))).toContain(chunks()[0]);
    expect(w.streamer.state.message).toBeNull();
    expect(w.network.aborted).toEqual([]);
  });

  test("wrong there and by itself: capped, and not asked for again", async () => {
    const { w, chunks } = made();
    w.network.faults.set(PACK, "corrupt");
    w.network.faults.set("*", "corrupt");
    w.network.faults.set("promises-1.json", []);
    await w.run({ mode: "full" });
    expect(chunks()).toHaveLength(1);
    const levels = shown(w.streamer.state);
    expect(levels.filter((level) => level < 4)).toHaveLength(1);
    expect(w.streamer.state.message).toContain(`${chunks()[0]} is damaged`);
    await w.pass(60_000);
    expect(chunks()).toHaveLength(1);
  });

  test("another file in its place: given up after two increments", async () => {
    const { w, chunks, twice } = made();
    w.network.files.set(PACK, new Uint8Array(w.manifest.pack?.bytes ?? 0));
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
    expect(w.network.aborted).toEqual([PACK]);
    expect(chunks()).toHaveLength(12);
    expect(twice()).toEqual([]);
    expect(w.streamer.state.message).toBeNull();
  });

  test("where nothing can be checked, what cannot be decoded is fetched by itself", async () => {
    const { w, chunks, file } = made({}, { digest: null });
    w.renderer.corrupt.add("1/3");
    w.set({ mode: "full" });
    w.streamer.start();
    await w.pass(700);
    w.renderer.corrupt.clear();
    await w.rest();
    expect(chunks()).toEqual([file(1, 3)]);
    expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  });
});
