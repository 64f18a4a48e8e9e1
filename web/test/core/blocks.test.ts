/** Scenes in blocks: what is in sight comes first, what is far and behind holds nothing up. */

import { expect, test } from "vitest";
import { parseManifest } from "../../src/core/manifest";
import { grouped, summary } from "../../src/ui/groups";
import { blocksBundle, startView } from "../blocks";
import { judge } from "../network";
import { Network, VirtualClock } from "../simulate";
import { type World, world } from "../world";
import { DEFAULTS, NO_BUDGET } from "../worlds";

const OPTIONS = { side: 3, categories: 4, levels: 5, bytes: 12_000, views: 6 };

function blocks(bytes = Number.POSITIVE_INFINITY, mode: "full" | "budget" = "full"): World {
  const clock = new VirtualClock();
  const network = new Network(clock);
  const manifest = blocksBundle(network, OPTIONS);
  const settings = { ...DEFAULTS, mode, budget: { ...NO_BUDGET, bytes } };
  const w = world({}, { manifest, settings, clock, fetch: network.fetch }, { clock, network } as World);
  w.streamer.update(startView());
  return w;
}

test("most of what one sees is there long before everything", async () => {
  const w = blocks();
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
    const levels = labels.map((label) => label.shown);
    curve.push({ bytes: bytesLoaded, ssim: ssim(startView(), levels) });
  };
  await w.run();
  told = 0;
  w.renderer.watch();
  const last = curve.at(-1)?.ssim ?? 0;
  const most = curve.find((one) => one.ssim >= 0.95 * last)?.bytes ?? Number.POSITIVE_INFINITY;
  expect(w.streamer.state.labels.every(({ shown }) => shown === 5)).toBe(true);
  expect(most).toBeLessThan(0.4 * w.streamer.state.bytesLoaded);
});

test("a budget leaves what is out of sight at its lowest level", async () => {
  const w = blocks(5e5, "budget");
  await w.run();
  const { labels, bytesShown } = w.streamer.state;
  expect(bytesShown).toBeLessThanOrEqual(5e5);
  expect(
    labels.flatMap(({ visible, shown }) => (visible ? [] : shown)).filter((shown) => shown !== 1),
  ).toEqual([]);
  expect(labels.some(({ visible, shown }) => visible && shown > 1)).toBe(true);
});

test("where not even the lowest levels fit, parts out of sight are left out, the least first", async () => {
  const w = blocks();
  const base = w.manifest.labels.reduce((sum, label) => sum + (label.levels[0]?.bytes ?? 0), 0);
  await w.run({ mode: "budget", budget: { ...NO_BUDGET, bytes: 0.7 * base } });
  const { labels, status, bytesShown } = w.streamer.state;
  expect(status).toBe("ok");
  expect(bytesShown).toBeLessThanOrEqual(0.7 * base);
  expect(labels.some(({ shown }) => !shown)).toBe(true);
  expect(labels.filter(({ visible }) => visible).every(({ shown }) => shown > 0)).toBe(true);
});

test("rows of categories sum up their parts", () => {
  const w = blocks();
  w.streamer.start();
  const groups = grouped(w.streamer.state.labels);
  expect(groups.length).toBe(4);
  for (const { states } of groups) {
    expect(states.map(({ label }) => label.block)).toEqual([...Array(9).keys()]);
    expect(summary(states).wanted).toBeLessThanOrEqual(1);
  }
  w.streamer.dispose();
});

test("parts say category and block, both or neither", () => {
  const { manifest } = blocks();
  const { labels } = parseManifest(JSON.stringify(manifest));
  expect([labels[9]?.category, labels[9]?.block]).toEqual(["category-1", 2]);
  const odd = { ...manifest, labels: manifest.labels.map(({ block: _, ...label }) => label) };
  expect(() => parseManifest(JSON.stringify(odd))).toThrow(/labels\[0\].block is missing/);
});
