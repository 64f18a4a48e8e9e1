import { expect, test } from "vitest";
import type { Camera, Manifest } from "../../src/types";
import { Network, VirtualClock } from "../simulate";
import { PROFILES, path, resized, stays, visit } from "../visitors";
import { bundle, documentOf } from "../worlds";

const camera = (i: number): Camera => ({
  name: `photo-${i}`,
  split: "train",
  position: [i, 0, i % 3],
  quaternion: [0, 0, 0, 1],
  fovY: 0.9,
  width: 200,
  height: 100,
  intrinsics: [100, 100, 100, 50],
});

/** A bundle of the tests with photos along x, and its page. */
function world() {
  const network = new Network(new VirtualClock());
  const manifest: Manifest = {
    ...bundle(network, { pack: true }),
    cameras: Array.from({ length: 12 }, (_, i) => camera(i)),
  };
  const promises = manifest.promises.fidelity?.uri ?? "";
  const text = new TextDecoder().decode(network.files.get(promises));
  const files = [
    { uri: "index.html", wire: 600 },
    { uri: "assets/index-AAAAAAAA.js", wire: 40_000 },
    { uri: "poster.jpg", wire: 9000 },
    { uri: promises, wire: text.length, text },
  ];
  return { manifest, files };
}

const [everything, target] = PROFILES;
if (!everything || !target) throw new Error("no profiles");

test("visitors walk no faster than 1.2 m/s, from the start, and repeat", () => {
  expect(stays(1001, 3).reduce((a, b) => a + b, 0) / 1001).toBeCloseTo(60, -0.5);
  const { manifest } = world();
  const [walk, again, other] = [path(manifest, 90, 5), path(manifest, 90, 5), path(manifest, 90, 6)];
  expect(walk(0).position).toEqual(manifest.start.position);
  let far = 0;
  for (let second = 0; second < 90; second += 0.5) {
    const [a, b] = [walk(second).position, walk(second + 0.5).position];
    const step = Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
    expect(step).toBeLessThanOrEqual(0.6 + 1e-9);
    far += step;
    expect(again(second)).toEqual(walk(second));
  }
  expect(far).toBeGreaterThan(10);
  expect(other(60)).not.toEqual(walk(60));
});

test("visitors ask for the page, then the manifest, then what the planner wants", async () => {
  const { manifest, files } = world();
  const log = await visit(manifest, files, everything, 20, 1);
  const order = log.map(({ uri }) => uri);
  expect(order[0]).toBe("index.html");
  expect(order.indexOf("manifest.json")).toBeGreaterThan(order.indexOf("assets/index-AAAAAAAA.js"));
  expect(order.indexOf(manifest.pack?.uri ?? "")).toBeGreaterThan(order.indexOf("manifest.json"));
  const came = (asked: typeof log) =>
    asked.filter(({ uri }) => /^chunks|pack$/.test(uri)).reduce((sum, { bytes }) => sum + bytes, 0);
  expect(came(log)).toBe(manifest.totals.bytes);
  const large = resized(JSON.stringify(documentOf(manifest)), 10);
  expect(came(await visit(large, files, everything, 20, 1))).toBe(10 * manifest.totals.bytes);
  expect(await visit(manifest, files, everything, 20, 1)).toEqual(log);
  const single = await visit({ ...manifest, pack: null }, files, target, 30, 1);
  const chunks = single.map(({ uri }) => uri).filter((uri) => uri.startsWith("chunks/"));
  expect(chunks.length).toBeGreaterThan(4);
  expect(new Set(chunks).size).toBe(chunks.length);
});
