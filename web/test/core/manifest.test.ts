/** What is refused of a bundle, and with which words. */

import { describe, expect, test } from "vitest";
import { BundleError } from "../../src/core/check";
import { loadManifest, parseManifest, parsePromises, VERSION } from "../../src/core/manifest";
import type { Manifest } from "../../src/types";
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
  expect(parseManifest(with_(good(), "labels.0.quality", null)).labels[0]?.quality).toBeNull();
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
  const names = paths(good(), "").filter((path) => !/\.\d+$|licenses/.test(path));
  test("there are many", () => expect(names.length).toBeGreaterThan(60));
  for (const path of names) {
    test(path, () => {
      const spelled = path.replace(/\.(\d+)/g, "[$1]");
      expect(complaint(() => parseManifest(with_(good(), path, undefined)))).toContain(
        `${spelled} is missing`,
      );
      const odd = path === "version" ? "one" : { odd: true };
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
      for (const path of ["labels.1.levels.0.uri", "promises.uri"]) {
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
  ["labels.0.levels.0.format", "ply", 'must be "spz"'],
  ["labels.0.quality.margin", [0], "labels[0].quality.margin"],
  ["labels.0.quality.curves.1.level", 1, "labels[0].quality.curves"],
  ["labels.0.quality.curves.1.level", 9, "labels[0].quality.curves"],
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
  const message = complaint(() => parseManifest('{"format":"sagesplat-bundle","version":1}'));
  expect(message).toContain("generator is missing; name is missing");
  expect(message).toMatch(/and \d+ more/);
});

test.each([
  ["labels.0.shares", [0.5], "labels[0] has lists"],
  ["labels.0.views", [0, 99], "labels[0] has lists"],
  ["labels.0.weights", [], "labels[0] has lists"],
  ["labels.0.noise", 0, "labels[0].noise must be a number above 0"],
  ["labels.0.lengths", [1, 0, 1], "labels[0].lengths[1]"],
  ["labels.0.unseenViews.0", 2, "labels[0].unseenViews[0]"],
  ["extent", "far", "extent must be a number"],
  ["views.0", [1], "views[0] must be a list of 6"],
])("promises: %s = %j", (path, value, message) => {
  expect(parsePromises(JSON.stringify(promises()), "p.json")).toEqual(promises());
  expect(complaint(() => parsePromises(with_(promises(), path, value), "p.json"))).toContain(message);
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
