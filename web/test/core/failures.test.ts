/** Links that break and files that are broken: named, and the rest lives on. */

import { expect, test } from "vitest";
import { leastPromise } from "../../src/core/describe";
import type { Fault } from "../simulate";
import { shown, world } from "../world";

const made = () => {
  const w = world({ labels: 3, levels: 4 });
  w.set({ mode: "full" });
  const file = w.manifest.labels[1]?.cells[0]?.levels[2]?.uri ?? "";
  const asked = () => w.network.asked.filter((path) => path === file).length;
  return { w, file, asked };
};

test.each<[string, Fault, string, number]>([
  ["a wrong hash", "corrupt", "its sha-256 is not that of the manifest", 2],
  ["a truncated file", "truncated", "is damaged: only", 2],
  ["a missing file", 404, "the server said 404", 1],
  ["a forbidden file", 403, "the server said 403", 1],
])("%s caps its label, which says so; others live on", async (_, fault, words, tries) => {
  const { w, file, asked } = made();
  w.network.faults.set(file, fault);
  await w.run();
  const { state } = w.streamer;
  expect(shown(state)).toEqual([4, 2, 4]);
  expect(state.labels[1]?.error).toContain(words);
  expect(state.labels[1]?.error).toContain(file);
  expect(state.labels[1]?.error).toContain("label 1 stays at level 2");
  expect(state.message).toBe(state.labels[1]?.error);
  expect(state.labels[0]?.error).toBeNull();
  expect(asked()).toBe(tries);
  await w.pass(60_000);
  expect(asked()).toBe(tries);
  expect(state.pending).toBe(0);
});

test("a first level that is broken leaves its label away", async () => {
  const { w } = made();
  const file = w.manifest.labels[2]?.cells[0]?.levels[0]?.uri ?? "";
  w.network.faults.set(file, "corrupt");
  await w.run();
  expect(shown(w.streamer.state)).toEqual([4, 4, 0]);
  expect(w.streamer.state.status).toBe("ok");
  expect(w.streamer.state.message).toContain("label 2 cannot be shown");
});

test("nothing is promised for what is missing, and of what is drawn no more than it keeps", async () => {
  const { w, file } = made();
  const first = w.manifest.labels[0]?.cells[0]?.levels[0]?.uri ?? "";
  w.network.faults.set(first, ["offline", "offline"]);
  w.network.faults.set(file, 404); // level 3 of label 1
  const least = () => leastPromise(w.streamer.state.labels);
  w.streamer.start();
  let missing = 0;
  for (let i = 0; i < 200; i++) {
    await w.pass(20);
    for (const { shown, promised } of w.streamer.state.labels) {
      if (!shown) expect(promised).toBeNaN();
    }
    const [a, ...others] = w.streamer.state.labels;
    if (!a?.shown && others.every(({ shown }) => shown)) {
      missing += 1;
      expect(least()).toBeNaN();
      expect(leastPromise(others)).toBeGreaterThan(0);
    }
  }
  expect(missing).toBeGreaterThan(0);
  await w.rest();
  const [, capped] = w.streamer.state.labels;
  expect(shown(w.streamer.state)).toEqual([4, 2, 4]);
  expect(least()).toBe(capped?.promised);
  await w.run({ mode: "base" });
  const [, lower] = w.streamer.state.labels;
  expect(lower?.promised).toBeLessThan(capped?.promised ?? 0);
});

test("a label without a promise lends none but in full, where it is as the full scene", async () => {
  const w = world({ labels: 2, levels: 3 });
  await w.run({ mode: "full" });
  const [known, other] = w.streamer.state.labels;
  if (!known || !other) throw new Error("no labels");
  expect(leastPromise([known, { ...other, promised: Number.NaN }])).toBe(known.promised);
  expect(leastPromise([known, { ...other, promised: Number.NaN, shown: 2 }])).toBeNaN();
  expect(leastPromise([{ ...known, promised: Number.NaN }])).toBeNaN();
  expect(leastPromise([])).toBeNaN();
});

test("a file that cannot be decoded caps its label", async () => {
  const { w, file } = made();
  w.renderer.corrupt.add("1/3");
  await w.run();
  expect(shown(w.streamer.state)).toEqual([4, 2, 4]);
  expect(w.streamer.state.message).toContain(`${file} cannot be decoded`);
});

test.each<[string, Fault[]]>([
  ["500, then good", [500, 503]],
  ["damaged once", ["corrupt"]],
  ["cut off", ["cut", "cut"]],
  ["offline for a moment", ["offline", "offline", "offline"]],
])("%s: tried again, without a word", async (_, faults) => {
  const { w, file, asked } = made();
  w.network.faults.set(file, [...faults]);
  await w.run();
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  expect(w.streamer.state.message).toBeNull();
  expect(asked()).toBe(faults.length + 1);
});

test("a server that falls silent is left after ten seconds", async () => {
  const { w, file } = made();
  w.network.faults.set(file, ["hang"]);
  w.streamer.start();
  await w.pass(9000);
  expect(shown(w.streamer.state)).toEqual([4, 2, 4]);
  expect(w.streamer.state.pending).toBeGreaterThan(0);
  await w.rest();
  expect(w.network.aborted).toContain(file);
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
});

test("waits between tries grow, and a failure is told of after some", async () => {
  const { w, file } = made();
  const times: number[] = [];
  const { fetch } = w.network;
  const timed: typeof fetch = (url, init) => {
    if (url.endsWith(file)) times.push(w.clock.now());
    return fetch(url, init);
  };
  const { streamer } = world({}, { manifest: w.manifest, fetch: timed }, w);
  streamer.set({ mode: "full" });
  w.network.faults.set(file, 500);
  streamer.start();
  await w.clock.pass(7000);
  expect(streamer.state.labels[1]?.error).toBeNull();
  await w.clock.pass(60_000);
  const waits = times.slice(1).map((time, i) => Math.round((time - (times[i] ?? 0) - 100) / 100) / 10);
  expect(waits.slice(0, 8)).toEqual([0.5, 1, 2, 4, 8, 15, 15, 15]);
  expect(streamer.state.labels[1]?.error).toContain("the server said 500; label 1 waits, trying again");
  expect(shown(streamer.state)).toEqual([4, 2, 4]);
});

test("offline for a minute: what is drawn stays, it is told, and all comes when the link is back", async () => {
  const { w } = made();
  w.streamer.start();
  await w.pass(350);
  const before = shown(w.streamer.state);
  expect(before.some((level) => level > 0)).toBe(true);
  w.network.faults.set("*", "offline");
  await w.pass(60_000);
  expect(w.streamer.state.message).toContain("the connection broke");
  await w.streamer.idle(); // nothing more can be had for now
  w.network.faults.clear();
  await w.pass(16_000);
  await w.rest();
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
  expect(w.streamer.state.message).toBeNull();
});

test("online again: retry does not wait", async () => {
  const { w } = made();
  w.network.faults.set("*", "offline");
  w.streamer.start();
  await w.pass(30_000);
  expect(w.streamer.state.status).toBe("loading");
  w.network.faults.clear();
  w.streamer.retry();
  await w.pass(2000);
  expect(shown(w.streamer.state)).toEqual([4, 4, 4]);
});

test.each<[Fault, string]>([
  [404, "the server said 404"],
  ["corrupt", "is damaged"],
])("without promises (%s) levels follow what holds everywhere", async (fault, words) => {
  const { w } = made();
  w.network.faults.set("promises-1.json", fault);
  await w.run({ mode: "target" });
  expect(w.streamer.state.message).toContain(words);
  expect(w.streamer.state.message).toContain("by what holds for all viewpoints");
  for (const label of w.streamer.state.labels) expect(label.promised).toBeGreaterThanOrEqual(0.8);
});

test("promises that cannot be read are told of", async () => {
  const { w } = made();
  const text = new TextEncoder().encode("{}");
  w.network.files.set("promises-1.json", text);
  const promises = { fidelity: { uri: "promises-1.json", bytes: 2, sha256: "", key: "" } };
  const other = world({}, { manifest: { ...w.manifest, promises }, digest: null }, w);
  other.streamer.start();
  await other.pass(5000);
  expect(other.streamer.state.message).toContain("promises-1.json: quality is missing");
});

test("without a digest files are checked by their size, and the user is told", async () => {
  const { w, file } = made();
  w.network.faults.set(file, "truncated");
  const other = world({}, { manifest: w.manifest, digest: null }, w);
  other.set({ mode: "full" });
  other.streamer.start();
  await other.pass(9000);
  expect(shown(other.streamer.state)).toEqual([4, 2, 4]);
  w.network.faults.set(file, "corrupt");
  other.streamer.retry();
  await other.pass(9000);
  expect(shown(other.streamer.state)).toEqual([4, 4, 4]);
  expect(other.streamer.state.message).toContain("checked by their size only");
});

test("the browser's fetch may be handed over as it is", async () => {
  const { w } = made();
  const { fetch } = w.network;
  function strict(this: unknown, ...args: Parameters<typeof fetch>) {
    if (this !== undefined) throw new TypeError("Illegal invocation");
    return fetch(...args);
  }
  const other = world({}, { manifest: w.manifest, fetch: strict }, w);
  other.streamer.start();
  await other.pass(5000);
  expect(other.streamer.state.status).toBe("ok");
});

test("a renderer that fails is told of", async () => {
  const { w } = made();
  w.renderer.swap = () => {
    throw new Error("context lost");
  };
  w.streamer.start();
  await w.clock.pass(2000);
  expect(w.streamer.state.message).toContain("context lost");
});
