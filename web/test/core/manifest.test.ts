/** What is refused of a bundle, and with which words. */

import { describe, expect, test } from "vitest";
import { BundleError } from "../../src/core/check";
import { loadManifest, parseManifest, parsePromises, VERSION } from "../../src/core/manifest";
import type { Level, Manifest } from "../../src/types";
import { Network, VirtualClock } from "../simulate";
import { BASE, bundle } from "../worlds";

type Json = Record<string, unknown>;
const network = new Network(new VirtualClock());
const good = (): Json => JSON.parse(JSON.stringify(bundle(network, { labels: 2, levels: 2, bytes: 100 })));
const promises = (): Json => JSON.parse(new TextDecoder().decode(network.files.get("promises-1.json")));

/** Sets what is at a path such as labels.0.id; undefined takes it away. */
function with_(document: Json, path: string, value: unknown): string {
  const keys = path.split(".");
  const last = keys.pop() ?? "";
  const inner = keys.reduce((at, key) => at[key] as Json, document);
  inner[last] = value;
  return JSON.stringify(document);
}

function complaint(run: () => unknown): string {
  try {
    run();
  } catch (error) {
    expect(error).toBeInstanceOf(BundleError);
    const { message } = error as BundleError;
    expect(message).not.toContain("\n");
    return message;
  }
  throw new Error("was accepted");
}

test("a good manifest is taken as it is", () => {
  const document = good();
  expect(parseManifest(JSON.stringify(document))).toEqual(document);
  expect(parseManifest(with_(good(), "labels", [])).labels).toEqual([]);
  expect(parseManifest(with_(good(), "labels.0.quality", {})).labels[0]?.quality).toEqual({});
  expect(parseManifest(with_(good(), "later", { any: "thing" }))).toBeTruthy();
});

test("a pack, none, or an older bundle", () => {
  const made = bundle(network, { labels: 2, levels: 2, bytes: 100, pack: true });
  const whole = (): Json => JSON.parse(JSON.stringify(made));
  expect(parseManifest(JSON.stringify(made)).pack).toEqual(made.pack);
  expect(parseManifest(with_(whole(), "pack", null)).pack).toBeNull();
  expect(parseManifest(with_(whole(), "pack", undefined)).pack).toBeUndefined();
  for (const [path, value, message] of [
    ["pack", 3, "pack must be an object"],
    ["pack.uri", "../scene.pack", "below the bundle's folder"],
    ["pack.sha256", "1", "pack.sha256 must be a sha-256"],
    ["pack.bytes", -1, "pack.bytes must be a whole number"],
    ["pack.bytes", 1, "pack.order must name levels that fill pack.bytes"],
    ["pack.order", [[0]], "pack.order[0] must be a list of 2"],
    ["pack.order.0", [9, 1], "pack.order must name levels"],
    ["pack.order.0", [0, 9], "pack.order must name levels"],
    ["pack.order.0", [0, 2], "pack.order must name levels"],
  ] as const) {
    expect(complaint(() => parseManifest(with_(whole(), path, value)))).toContain(message);
  }
});

test("a level that adds nothing needs no file", () => {
  const empty = { uri: "", format: "spz", bytes: 0, gpuBytes: 0, count: 0, sha256: "" };
  expect(parseManifest(with_(good(), "labels.0.levels.1", empty)).labels[0]?.levels[1]?.count).toBe(0);
});

test("levels of a stream are ranges of one file", () => {
  const made = bundle(network, { labels: 2, levels: 3, bytes: 100, streams: true });
  const whole = (): Json => JSON.parse(JSON.stringify(made));
  expect(parseManifest(JSON.stringify(made))).toEqual(made);
  const [first, second] = (made.labels[0]?.levels ?? []) as [Level, Level];
  const other = made.labels[1]?.levels[0]?.uri;
  const levels = "labels.0.levels";
  const touch = "labels[0].levels must be ranges of their stream without gaps, from byte 0 on";
  const alone = "labels[0].levels must be one stream of their own";
  for (const [path, value, message] of [
    ["version", 3, "labels[0].levels have streams, which version 3 does not have"],
    [`${levels}.0.offset`, undefined, touch],
    [`${levels}.0.offset`, 1, touch],
    [`${levels}.1.offset`, (second.offset ?? 0) + 1, touch],
    [`${levels}.1.offset`, (second.offset ?? 0) - 1, touch],
    [`${levels}.1.offset`, -1, "levels[1].offset must be a whole number from 0 on"],
    [`${levels}.1.offset`, 0.5, "levels[1].offset must be"],
    [`${levels}.1.offset`, null, "levels[1].offset must be"],
    [`${levels}.0.bytes`, first.bytes - 1, touch],
    [`${levels}.1.uri`, "chunks/other.sgst", alone],
    [`${levels}.1.format`, "spz", alone],
    [`${levels}.1.refine`, "REPLACE", alone],
    [`${levels}.1.weight`, 0.5, "labels[0].levels must all have a weight, or none"],
    [`${levels}.1.weight`, 1.5, "levels[1].weight must be a number from 0 to 1"],
    [`${levels}.1.weight`, null, "levels[1].weight must be"],
  ] as const) {
    expect(complaint(() => parseManifest(with_(whole(), path, value)))).toContain(message);
  }
  const twice = whole();
  for (let k = 0; k < 3; k++) with_(twice, `labels.1.levels.${k}.uri`, first.uri);
  const same = complaint(() => parseManifest(JSON.stringify(twice)));
  expect(same).toContain("labels[1].levels must be one stream of their own");
  expect(other).not.toBe(first.uri);
  const plain = with_(good(), "labels.0.levels.1.offset", 0);
  expect(complaint(() => parseManifest(plain))).toContain("have offsets or weights, which only streams have");
});

test("levels of a stream may have weights, and add nothing", () => {
  const document = JSON.parse(
    JSON.stringify(bundle(network, { labels: 1, levels: 3, bytes: 100, streams: true })),
  );
  for (const [k, weight] of [0, 0.2, 1].entries()) with_(document, `labels.0.levels.${k}.weight`, weight);
  expect(parseManifest(JSON.stringify(document)).labels[0]?.levels[1]?.weight).toBe(0.2);
  const empty = { format: "stream", bytes: 0, gpuBytes: 0, count: 0, weight: 1 };
  const { levels } = document.labels[0];
  expect(parseManifest(with_(document, "labels.0.levels", [...levels, empty])).labels[0]?.levels.length).toBe(
    4,
  );
});

test("a level may replace those below, if there are any", () => {
  const level = "labels.0.levels.1";
  const read = (path: string, value: unknown) => parseManifest(with_(good(), path, value));
  expect(read(`${level}.refine`, "REPLACE").labels[0]?.levels[1]?.refine).toBe("REPLACE");
  expect(read(`${level}.format`, "ply").labels[0]?.levels[1]?.format).toBe("ply");
  const empty = { uri: "", format: "spz", refine: "REPLACE", bytes: 0, gpuBytes: 0, count: 0, sha256: "" };
  for (const [path, value, message] of [
    [`${level}.refine`, "SWAP", "levels[1].refine must be"],
    [`${level}.refine`, null, "levels[1].refine must be"],
    [`${level}.format`, "ksplat", "levels[1].format must be"],
    ["labels.0.levels.0.refine", "REPLACE", "labels[0].levels[0] has nothing to replace"],
    [level, empty, "labels[0].levels[1] has nothing to replace"],
  ] as const) {
    expect(complaint(() => read(path, value))).toContain(message);
  }
});

test("a newer version says so, whatever else it holds", () => {
  const document = { format: "sagesplat-bundle", version: VERSION + 1 };
  const message = complaint(() => parseManifest(JSON.stringify(document)));
  expect(message).toContain(`has version ${VERSION + 1}, this viewer reads up to ${VERSION}`);
});

describe("every field is needed", () => {
  const paths = (value: unknown, path: string): string[] => {
    if (typeof value !== "object" || value === null) return [path];
    const own = Object.entries(value).flatMap(([key, v]) => paths(v, path ? `${path}.${key}` : key));
    return path ? [path, ...own] : own;
  };
  const names = paths(good(), "").filter((path) => !/\.\d+$|licenses|\.fidelity$/.test(path));
  test("there are many", () => expect(names.length).toBeGreaterThan(60));
  for (const path of names) {
    test(path, () => {
      const spelled = path.replace(/\.(\d+)/g, "[$1]");
      expect(complaint(() => parseManifest(with_(good(), path, undefined)))).toContain(
        `${spelled} is missing`,
      );
      const odd = path === "version" ? "one" : /promises$|quality$/.test(path) ? 3 : { odd: true };
      expect(complaint(() => parseManifest(with_(good(), path, odd)))).toContain(spelled);
    });
  }
});

describe("paths stay below the bundle", () => {
  const bad = [
    "../a.spz",
    "chunks/../../a.spz",
    "/a.spz",
    "\\a.spz",
    "chunks\\..\\a.spz",
    "http://example.org/a.spz",
    "//example.org/a.spz",
    "data:,x",
    "%2e%2e/a.spz",
    "chunks/%2E%2e/a.spz",
    "chunks//a.spz",
    "./a.spz",
    ".hidden",
    "a.spz?x",
    "a.spz#x",
    " a.spz",
    "",
  ];
  for (const uri of bad) {
    test(JSON.stringify(uri), () => {
      for (const path of ["labels.1.levels.0.uri", "promises.fidelity.uri"]) {
        expect(complaint(() => parseManifest(with_(good(), path, uri)))).toContain(
          "below the bundle's folder",
        );
      }
    });
  }
});

test.each([
  ["labels.0.levels", [], "labels[0].levels is empty"],
  ["labels.1.id", 0, "same id"],
  ["labels.0.boxes", [[1, 0, 0, 0, 0, 0]], "labels[0].boxes"],
  ["labels.0.boxes", [[1, 0]], "labels[0].boxes[0] must be a list of 6"],
  ["labels.0.weight", -1, "labels[0].weight must be a number from 0 on"],
  ["labels.0.color", "red", "labels[0].color"],
  ["labels.0.levels.0.sha256", "12", "labels[0].levels[0].sha256"],
  ["labels.0.levels.0.bytes", 1.5, "labels[0].levels[0].bytes"],
  ["labels.0.levels.0.format", "ksplat", 'must be "spz"'],
  ["labels.0.quality.fidelity.mean", [0], "labels[0].quality.fidelity must have a number a level"],
  ["labels.0.quality.fidelity.bound", [0], "labels[0].quality.fidelity must have a number a level"],
  ["labels.0.quality.fidelity.levels.1", 1, "labels[0].quality.fidelity.levels must rise"],
  ["labels.0.quality.fidelity.levels.1", 9, "labels[0].quality.fidelity.levels must rise"],
  ["labels.0.quality.fidelity.mean.1", 2, "labels[0].quality.fidelity.mean[1] must be a number from -1 to 1"],
  ["target.quality", "psnr", 'target.quality must be "fidelity" or "ssim"'],
  ["target.value", null, "target.value must be a number"],
  ["frame.axes", "rdf", 'frame.axes must be "rub"'],
  ["frame.metersPerUnit", 0, "frame.metersPerUnit must be a number above 0"],
  ["labels", {}, "labels must be a list"],
  ["format", "other", "sagesplat-bundle"],
])("%s = %j", (path, value, message) => {
  expect(complaint(() => parseManifest(with_(good(), path, value)))).toContain(message);
});

test("no JSON, and JSON of other kinds", () => {
  expect(complaint(() => parseManifest("{"))).toContain("not JSON");
  for (const text of ["null", "[]", "3"])
    expect(complaint(() => parseManifest(text))).toContain("must be an object");
  expect(
    complaint(() => parseManifest(JSON.stringify(good()).replace('"floor":-1', '"floor":1e999'))),
  ).toContain("frame.floor must be a number");
});

test("many things wrong are named up to a few", () => {
  const message = complaint(() => parseManifest('{"format":"sagesplat-bundle","version":2}'));
  expect(message).toContain("generator is missing; name is missing");
  expect(message).toMatch(/and \d+ more/);
});

test.each([
  ["version", 1, "version must be 2"],
  ["quality", "ssim", 'quality must be "fidelity"'],
  ["extent", "far", "extent must be a number"],
  ["views", [[1]], "views must be a list of 6"],
  ["views.0", [1], "views must have columns of equal length"],
  ["views.0.1", 0.5, "views[0][1] must be a whole number"],
  ["labels.0.shares", [5000], "labels[0] has lists"],
  ["labels.0.shares.0", 20_000, "labels[0] has shares or corrections out of range"],
  ["labels.0.corrections.0", 1e9, "labels[0] has shares or corrections out of range"],
  ["labels.0.views", [0, 99], "labels[0] has lists"],
  ["labels.0.views.1", 99, "labels[0] has lists"],
  ["labels.0.values.steps", [], "labels[0] has lists"],
  ["labels.0.values.steps.0", [1], "labels[0] has lists"],
  ["labels.0.values.steps.0.0", 1e10, "labels[0] has values out of range"],
  ["labels.0.values.units.0", 0, "labels[0].values.units[0] must be a number from"],
  ["labels.0.values.units", [1], "labels[0] has lists"],
  ["labels.0.offsets", [0], "labels[0] has lists"],
  [
    "labels.0.curves",
    [{ params: [1, 0, 0, 1, 1, 0, 0, 1, 0], range: [0, 1], median: 1 }],
    "labels[0] has lists",
  ],
  ["labels.0.logDistances.steps.0", 1e6, "labels[0] has values out of range"],
  ["labels.0.levels", [2, 1], "labels[0].levels must rise"],
  ["labels.0.lengths", [1, 0, 1], "labels[0].lengths[1]"],
  ["labels.0.leastSupport", 2, "labels[0].leastSupport must be a number from 0 to 1"],
  ["labels.0.thresholds", [1, 2], "labels[0] has lists"],
  ["labels.0.thresholds.1", 3200, "labels[0] must have targets and thresholds that rise"],
  ["labels.0.targets.3", 10_001, "labels[0] must have targets and thresholds that rise"],
  ["labels.0.status", "pooled", "labels[0].status must be"],
])("promises: %s = %j", (path, value, message) => {
  const parsed = (json: string) => parsePromises(json, "p.json", "fidelity");
  expect(parsed(JSON.stringify(promises()))).toEqual(promises());
  expect(complaint(() => parsed(with_(promises(), path, value)))).toContain(message);
});

test("a bundle of version 1 is shown without promises", () => {
  const old = { ...good(), version: 1, promises: { uri: "promises-1.json", bytes: 9, sha256: "0" } };
  const { target, ...rest } = old as Json;
  expect(target).toBeTruthy();
  const labels = (rest.labels as Json[]).map((label, i) => ({
    ...label,
    quality: i ? null : { status: "pooled", confidence: 0.95, margin: [0], curves: [] },
  }));
  const found = parseManifest(JSON.stringify({ ...rest, labels }));
  expect(found.promises).toEqual({});
  expect(found.labels.map(({ quality }) => quality)).toEqual([{}, {}]);
  expect(complaint(() => parseManifest(JSON.stringify({ ...rest, labels: [3] })))).toContain(
    "labels[0] must be an object",
  );
});

describe("loading", () => {
  const load = async (prepare: (network: Network, manifest: Manifest) => void) => {
    const clock = new VirtualClock();
    const network = new Network(clock);
    const manifest = bundle(network, { labels: 1, bytes: 100 });
    network.files.set("manifest.json", new TextEncoder().encode(JSON.stringify(manifest)));
    prepare(network, manifest);
    const loaded = loadManifest(BASE, network.fetch).then(
      (found) => found.name,
      (error: unknown) => (error instanceof BundleError ? error.message : "another error"),
    );
    await clock.pass(1000);
    return loaded;
  };
  test("works", async () => expect(await load(() => {})).toBe("test"));
  test.each([
    [(n: Network) => n.files.delete("manifest.json"), "there is no bundle here"],
    [(n: Network) => n.faults.set("*", 500), "the server said 500"],
    [(n: Network) => n.faults.set("*", "offline"), "cannot be reached"],
    [(n: Network) => n.faults.set("*", "cut"), "cannot be reached"],
    [(n: Network) => n.faults.set("*", "truncated"), "not JSON"],
  ])("fails with words", async (prepare, words) => {
    const message = await load(prepare);
    expect(message).toContain(words);
    expect(message).toContain("manifest.json");
  });
});
