/** What is loaded, drawn, kept and given up. */

import { describe, expect, test } from "vitest";
import { digestOfBrowser } from "../../src/core/download";
import { type Network, settled } from "../simulate";
import { shown, type World, wanted, world } from "../world";
import { at, bundle, documentOf, FOCAL, NO_BUDGET, rightOf, totals } from "../worlds";

const chunks = (paths: readonly string[]) => paths.filter((path) => path.startsWith("chunks/"));
const twice = (paths: readonly string[]) => paths.filter((path, i) => paths.indexOf(path) < i);

test("the smallest level of everything comes first, then the promises, then the plan", async () => {
  const w = world({ labels: 4, levels: 5 });
  w.streamer.start();
  expect(w.streamer.state.status).toBe("loading");
  await w.rest();
  const { asked } = w.network;
  expect(chunks(asked.slice(0, 4)).every((path) => /-1-1\.spz$/.test(path))).toBe(true);
  expect(asked[4]).toBe("promises-1.json");
  expect(twice(asked)).toEqual([]);
  const { state } = w.streamer;
  expect(shown(state)).toEqual(wanted(state));
  expect(state.status).toBe("ok");
  expect(state.pending).toBe(0);
  expect(state.message).toBeNull();
  for (const label of state.labels) expect(label.promised).toBeGreaterThanOrEqual(0.8);
  expect(w.network.most).toBeLessThanOrEqual(8);
});

test("bytes, GPU bytes, counts and the speed of the link are those of what came", async () => {
  const w = world({ labels: 3, levels: 4 });
  w.network.bandwidth = 2e6;
  w.network.latency = 0;
  await w.run({ mode: "full" });
  const { state } = w.streamer;
  expect(state.count).toBe(w.manifest.totals.count);
  expect(state.bytesShown).toBe(w.manifest.totals.bytes);
  expect(state.gpuBytes).toBe(w.manifest.totals.gpuBytes);
  expect(state.bytesLoaded).toBe(w.manifest.totals.bytes + (w.manifest.promises.fidelity?.bytes ?? 0));
  expect(state.bandwidth / 2e6).toBeCloseTo(1, 1);
});

test("every mode and its status", async () => {
  const w = world({ labels: 4, levels: 5 });
  await w.run();
  await w.run({ mode: "base" });
  expect(shown(w.streamer.state)).toEqual([1, 1, 1, 1]);
  await w.run({ mode: "full" });
  expect(shown(w.streamer.state)).toEqual([5, 5, 5, 5]);
  await w.run({ mode: "target", target: 1 });
  expect(w.streamer.state.status).toBe("infeasible");
  await w.run({ mode: "full", budget: { ...NO_BUDGET, count: w.manifest.totals.count / 2 } });
  expect(w.streamer.state.status).toBe("infeasible");
  expect(w.streamer.state.count).toBeLessThanOrEqual(w.manifest.totals.count / 2);
  await w.run({ mode: "budget" });
  expect(w.streamer.state.status).toBe("ok");
  for (const unit of ["bytes", "gpuBytes", "count"]) {
    await w.run({ budget: { ...NO_BUDGET, [unit]: 0 } });
    expect(w.streamer.state.status).toBe("over budget");
    expect(shown(w.streamer.state)).toEqual([1, 1, 1, 1]);
  }
  await w.run({ budget: { bytes: Number.NaN, gpuBytes: Number.NaN, count: Number.NaN } });
  expect(w.streamer.state.status).toBe("ok");
});

test("labels out of sight or of weight 0 want their lowest level, and come back at once from memory", async () => {
  const w = world({ labels: 4, levels: 5 });
  await w.run();
  const before = shown(w.streamer.state);
  const asked = w.network.asked.length;
  w.streamer.update(rightOf(at(0)));
  await w.pass(200);
  const [left, ...others] = w.streamer.state.labels;
  expect(left).toMatchObject({ visible: false, distance: Number.NaN });
  expect([wanted(w.streamer.state)[0], shown(w.streamer.state)[0]]).toEqual([1, 1]);
  expect(others.at(-1)?.visible).toBe(true);
  w.streamer.update(at(0));
  await w.pass(200);
  expect(shown(w.streamer.state)[0]).toBeGreaterThan(1);
  expect(shown(w.streamer.state).slice(1)).toEqual(before.slice(1));
  w.set({ weights: new Map([[1, 0]]) });
  await w.pass(200);
  expect(shown(w.streamer.state)[1]).toBe(1);
  expect(w.network.asked.length).toBe(asked);
});

test("a label that is always shipped is whole in every mode, and paid first", async () => {
  const clocked = world({ labels: 3, levels: 4 });
  const labels = clocked.manifest.labels.map((label, i) => ({ ...label, always: i === 0 }));
  const w = world({}, { manifest: { ...clocked.manifest, labels } }, clocked);
  w.streamer.start();
  w.set({ mode: "base" });
  await clocked.pass(5000);
  expect(shown(w.streamer.state)).toEqual([4, 1, 1]);
  const own = totals(labels.slice(0, 1)).count;
  w.set({ mode: "budget", budget: { ...NO_BUDGET, count: own + 10 } });
  await clocked.pass(5000);
  expect(w.streamer.state).toMatchObject({ status: "over budget" });
  expect(shown(w.streamer.state)).toEqual([4, 1, 1]);
  w.streamer.dispose();
});

test("a bundle without labels, and a label without quality", async () => {
  const none = world({ labels: 0 });
  await none.run();
  expect(none.streamer.state).toMatchObject({ status: "ok", labels: [], count: 0, message: null });
  const made = world({ labels: 3, levels: 4, promises: false });
  const labels = made.manifest.labels.map((label, i) => ({
    ...label,
    quality: i ? label.quality : {},
  }));
  const w = world({}, { manifest: { ...made.manifest, labels } }, made);
  w.streamer.start();
  await made.pass(5000);
  const [unknown, known] = w.streamer.state.labels;
  expect(unknown).toMatchObject({ shown: 1, promised: Number.NaN, expected: Number.NaN });
  expect(known?.promised).toBeGreaterThan(0.5);
  w.set({ mode: "budget", budget: { ...NO_BUDGET, bytes: w.manifest.totals.bytes / 2 } });
  await made.pass(5000);
  expect(w.streamer.state.status).toBe("ok");
});

describe("limits", () => {
  /** Full, then base, then full again. */
  const again = async (w: World) => {
    await w.run({ mode: "full" });
    await w.run({ mode: "base" });
    const kept = { alive: w.renderer.alive.size, gpuBytes: w.streamer.state.gpuBytes };
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual(w.manifest.labels.map((label) => label.cells[0]?.levels.length));
    return kept;
  };

  test("with room nothing is fetched or decoded twice", async () => {
    const w = world({ labels: 3, levels: 4 });
    await again(w);
    expect(twice(w.network.asked)).toEqual([]);
    expect(w.renderer.decoded).toBe(12);
  });

  test("hidden increments are disposed of beyond the limit, the top ones first, and decoded again from memory", async () => {
    const w = world({ labels: 3, levels: 4 });
    const limit = Math.round(w.manifest.totals.gpuBytes / 3);
    w.set({ cacheBytes: limit });
    const kept = await again(w);
    const base = w.manifest.labels.reduce(
      (sum, label) => sum + (label.cells[0]?.levels[0]?.gpuBytes ?? 0),
      0,
    );
    expect(kept.gpuBytes).toBeLessThanOrEqual(base + limit);
    expect(kept.gpuBytes).toBeGreaterThan(base);
    expect(twice(w.network.asked)).toEqual([]);
    expect(w.renderer.decoded).toBeGreaterThan(12);
  });

  test("no room at all: all hidden ones go, and are fetched again", async () => {
    const w = world({ labels: 3, levels: 4 }, { keepBytes: 0 });
    w.set({ cacheBytes: 0 });
    expect((await again(w)).alive).toBe(3);
    expect(twice(chunks(w.network.asked))).toHaveLength(9);
  });

  test("dispose lets go of everything, even of what comes later", async () => {
    const w = world({ labels: 3, levels: 4 });
    w.set({ mode: "full" });
    w.streamer.start();
    await w.pass(320);
    expect(w.renderer.alive.size).toBeGreaterThan(0);
    w.streamer.dispose();
    w.streamer.dispose();
    const asked = w.network.asked.length;
    await w.clock.pass(20_000);
    expect(w.renderer.alive.size).toBe(0);
    expect(w.renderer.drawn.size).toBe(0);
    expect(w.network.asked.length).toBe(asked);
    await w.streamer.idle();
  });
});

describe("aborts", () => {
  const big = { labels: 1, levels: 3, bytes: 400_000, promises: false };
  const started = async (wait: number) => {
    const w = world(big);
    await w.run({ mode: "base" });
    w.set({ mode: "full" });
    await w.pass(wait);
    w.set({ mode: "base" });
    await w.pass(200);
    return w;
  };

  test("what is no longer wanted is aborted, and fetched when it is wanted again", async () => {
    const w = await started(250);
    expect(w.network.aborted).toHaveLength(2);
    expect(w.streamer.state.pending).toBe(0);
    await w.run({ mode: "full" });
    expect(shown(w.streamer.state)).toEqual([3]);
    expect(w.streamer.state.message).toBeNull();
  });

  test("what is nearly there may come, and is kept", async () => {
    const w = world(big, { downloads: 1 });
    await w.run({ mode: "base" });
    w.set({ mode: "full" });
    const second = w.manifest.labels[0]?.cells[0]?.levels[1]?.bytes ?? 0;
    await w.pass(100 + 0.95 * (second / 1e6) * 1000);
    await w.run({ mode: "base" });
    expect(w.network.aborted).toEqual([]);
    expect(shown(w.streamer.state)).toEqual([1]);
    await w.run({ mode: "full" });
    expect(twice(w.network.asked)).toEqual([]);
  });
});

test("plans at most 8 times a second, and only when something changed", async () => {
  const w = world({ labels: 2, levels: 3 });
  await w.run();
  let changes = 0;
  const stop = w.streamer.onChange(() => changes++);
  for (let frame = 0; frame < 60; frame++) {
    w.streamer.update(at(frame / 100));
    await w.pass(1000 / 60);
  }
  expect(changes).toBeGreaterThanOrEqual(7);
  expect(changes).toBeLessThanOrEqual(9);
  await w.pass(200);
  changes = 0;
  for (let frame = 0; frame < 60; frame++) {
    w.streamer.update(at(59 / 100));
    await w.pass(1000 / 60);
  }
  expect(changes).toBe(0);
  stop();
  await w.run({ mode: "full" });
  expect(changes).toBe(0);
});

test("on a slow link few large files come at a time, on a fast one of small files more", async () => {
  const slow = world({ labels: 6, levels: 4, bytes: 100_000, promises: false });
  slow.network.bandwidth = 250_000;
  slow.set({ mode: "full" });
  slow.streamer.start();
  await slow.pass(2000);
  slow.network.most = 0;
  await slow.pass(5000);
  expect(slow.streamer.state.bandwidth).toBeGreaterThan(2e5);
  expect(slow.network.most).toBeLessThanOrEqual(3);
  const fast = world({ labels: 6, levels: 4, bytes: 5000, promises: false });
  fast.network.bandwidth = 6e6;
  await fast.run({ mode: "full" });
  expect(fast.network.most).toBeGreaterThan(8);
  expect(fast.network.most).toBeLessThanOrEqual(16);
});

test("real digests, where the machine has them", async () => {
  expect(await digestOfBrowser?.(new TextEncoder().encode("abc"))).toBe(
    "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
  );
});

describe("a live bundle", () => {
  const publish = (network: Network, seed: number, labels: number, live = true) => {
    const manifest = bundle(network, { labels, levels: 1, live, seed, promises: false });
    network.files.set("manifest.json", new TextEncoder().encode(JSON.stringify(documentOf(manifest))));
    return manifest;
  };
  const running = async () => {
    const first = world({ labels: 0 });
    const { network } = first;
    const manifest = publish(network, 1, 3);
    const w = world({}, { manifest }, first);
    w.streamer.start();
    await w.pass(1500);
    return { w, network };
  };

  test("new content takes the place of the old in one tick", async () => {
    const { w, network } = await running();
    const old = [...w.renderer.drawn];
    expect(old).toHaveLength(3);
    w.renderer.swaps = [];
    publish(network, 2, 3);
    await w.pass(3000);
    expect(w.renderer.swaps).toHaveLength(1);
    expect(new Set(w.renderer.swaps[0]?.hide)).toEqual(new Set(old));
    expect(w.renderer.swaps[0]?.show).toHaveLength(3);
    expect(w.renderer.alive.size).toBe(3);
    expect(w.streamer.manifest.labels[0]?.cells[0]?.levels[0]?.uri).toContain("-2.spz");
  });

  test("the same manifest costs a 304, and labels come and go", async () => {
    const { w, network } = await running();
    const loaded = w.streamer.state.bytesLoaded;
    await w.pass(6000);
    expect(network.asked.filter((path) => path === "manifest.json").length).toBeGreaterThanOrEqual(3);
    expect(w.streamer.state.bytesLoaded).toBe(loaded);
    publish(network, 3, 2);
    await w.pass(4000);
    expect(w.renderer.drawn.size).toBe(2);
    publish(network, 4, 4);
    await w.pass(4000);
    expect(shown(w.streamer.state)).toEqual([1, 1, 1, 1]);
    expect(w.renderer.alive.size).toBe(4);
    publish(network, 5, 4, false);
    await w.pass(4000);
    const asked = network.asked.length;
    await w.pass(10_000);
    expect(network.asked.length).toBe(asked);
  });

  test("a missing chunk of a new snapshot leaves the old one, until there is another", async () => {
    const { w, network } = await running();
    const next = publish(network, 2, 3);
    const missing = next.labels[1]?.cells[0]?.levels[0]?.uri ?? "";
    network.files.delete(missing);
    await w.pass(4000);
    expect(w.renderer.levels(1)).toEqual([1]);
    expect(w.streamer.state.message).toContain(missing);
    publish(network, 3, 3);
    await w.pass(4000);
    expect(w.streamer.state.message).toBeNull();
    expect(w.renderer.alive.size).toBe(3);
  });

  test("a broken or unreachable manifest is told of, and what is drawn stays", async () => {
    const { w, network } = await running();
    network.files.set("manifest.json", new TextEncoder().encode("{"));
    await w.pass(2500);
    expect(w.streamer.state.message).toContain("not JSON");
    network.faults.set("manifest.json", "offline");
    await w.pass(2500);
    expect(w.streamer.state.message).toContain("cannot be reached");
    network.faults.clear();
    publish(network, 2, 3);
    await w.pass(4000);
    expect(w.streamer.state.message).toBeNull();
    expect(shown(w.streamer.state)).toEqual([1, 1, 1]);
  });
});

test("changing the state inside a callback does no harm", async () => {
  const w = world({ labels: 2, levels: 3 });
  let calls = 0;
  w.streamer.onChange(() => {
    calls += 1;
    if (calls < 5) w.streamer.set({ target: 0.7 + calls / 50 });
  });
  await w.run();
  await settled();
  expect(calls).toBeGreaterThan(5);
});

test("another screen is another viewpoint: promises are those of its sharpness", async () => {
  const w = world({ labels: 3, levels: 5 });
  expect(w.streamer.state.screens).toBeNull();
  await w.run({ mode: "full" });
  expect(w.streamer.state.screens).toEqual({ least: 0.5, most: 2, here: 1, fov: 53 });
  const expected = () => w.streamer.state.labels.map((label) => label.expected);
  const see = async (focal?: number) => {
    w.streamer.update({ ...at(0), ...(focal && { focal }) });
    await w.pass(500);
    return expected();
  };
  const photos = await see();
  expect(await see(FOCAL)).toEqual(photos);
  const sharper = await see(2 * FOCAL);
  expect(sharper).not.toEqual(photos);
  expect(w.streamer.state.screens?.here).toBe(2);
  expect(await see(3 * FOCAL)).toEqual(sharper);
  expect(w.streamer.state.screens?.here).toBe(3);
});
