/** Manifests and promises: what is taken, and what is refused with which words. */

import { readFileSync } from "node:fs";
import { describe, expect, test } from "vitest";
import vectors from "../../../tests/data/promises.json?raw";
import { TYPES, typesOfSchema } from "../../schema";
import { loadManifest, parseManifest, parsePromises, VERSION } from "../../src/core/manifest";
import { BundleError } from "../../src/core/schema";
import type { Manifest as Document } from "../../src/documents";
import { Network, VirtualClock } from "../simulate";
import { BASE, base64, bundle, documentOf, type Options } from "../worlds";

type Json = Record<string, unknown>;
const network = new Network(new VirtualClock());
const made = (options: Options): Document =>
  documentOf(bundle(network, { labels: 2, bytes: 100, ...options }));
const plain = made({ levels: 2 });
const promises = JSON.parse(new TextDecoder().decode(network.files.get("promises-1.json")));
const packed = made({ levels: 2, pack: true });
const streams = made({ levels: 3, streams: true });
const parted = made({ cells: 3, levels: 2, streams: true, pack: true });
const replacing = made({ cells: 3, levels: 4, streams: true, replaces: [2, 4] });

/** A document with another value at a path such as labels.0.id; undefined takes it away. */
function changed(document: unknown, path: string, value: unknown): string {
  const copy = JSON.parse(JSON.stringify(document));
  const keys = path.split(".");
  const last = keys.pop() ?? "";
  const inner = keys.reduce((at, key) => at[key] as Json, copy);
  inner[last] = value;
  return JSON.stringify(copy);
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

const refusal = (document: unknown, path: string, value: unknown) =>
  complaint(() => parseManifest(changed(document, path, value)));

test("the types are those of the schema", async () => {
  expect(readFileSync(TYPES, "utf8")).toBe(await typesOfSchema());
});

test("a good manifest is taken as it is, with fields of later versions", () => {
  for (const options of [{}, { pack: true }, { streams: true, cells: 2, palette: 20, replaces: [3] }]) {
    const manifest = bundle(network, options);
    expect(parseManifest(JSON.stringify(documentOf(manifest)))).toEqual(manifest);
  }
  for (const [path, value] of [
    ["labels", []],
    ["labels.0.quality", {}],
    ["labels.0.cells.0.levels.1.refine", "REPLACE"],
    ["labels.0.cells.0.levels.1.format", "ply"],
    ["later", { any: "thing" }],
  ] as const) {
    expect(parseManifest(changed(plain, path, value))).toBeTruthy();
  }
  const found = parseManifest(changed(streams, "labels.0.cells.0.levels.0.weights", [0, 0.5, 1]));
  expect(found.labels[0]?.cells[0]?.levels[1]?.weight).toBe(0.5);
  const files = plain.labels[0]?.cells[0]?.levels.map((level) => ({ ...level, refine: "REPLACE" }));
  const highest = [...(replacing.labels[0]?.cells[2]?.levels ?? []), ...(files ?? [])];
  expect(parseManifest(changed(replacing, "labels.0.cells.2.levels", highest))).toBeTruthy();
});

test("another version says so, whatever else it holds", () => {
  const document = { format: "sagesplat-bundle", version: VERSION + 1 };
  const message = complaint(() => parseManifest(JSON.stringify(document)));
  expect(message).toContain(`has version ${VERSION + 1}, this viewer reads version ${VERSION}`);
});

test("every field is needed, and has its kind", () => {
  const paths = (value: unknown, path: string): string[] => {
    if (typeof value !== "object" || value === null) return [path];
    const own = Object.entries(value).flatMap(([key, v]) => paths(v, path ? `${path}.${key}` : key));
    return path ? [path, ...own] : own;
  };
  const names = paths(plain, "").filter((path) => !/\.\d+$|\.fidelity$/.test(path));
  expect(names.length).toBeGreaterThan(60);
  for (const path of names) {
    const spelled = path.replace(/\.(\d+)/g, "[$1]");
    expect(refusal(plain, path, undefined)).toContain(`${spelled} is missing`);
    const odd = /promises$|quality$/.test(path) ? 3 : { odd: true };
    expect(refusal(plain, path, odd)).toContain(spelled);
  }
});

test.each([
  "../a.spz",
  "chunks/../../a.spz",
  "/a.spz",
  "\\a.spz",
  "chunks\\..\\a.spz",
  "http://example.org/a.spz",
  "//example.org/a.spz",
  "data:,x",
  "%2e%2e/a.spz",
  "chunks//a.spz",
  "./a.spz",
  ".hidden",
  "a.spz?x",
  "a.spz#x",
  " a.spz",
  "",
])("%j is no path below the bundle", (uri) => {
  for (const path of ["labels.1.cells.0.levels.0.uri", "promises.fidelity.uri"]) {
    expect(refusal(plain, path, uri)).toContain("uri must be a path below the bundle's folder");
  }
});

const LEVELS = "labels.0.cells.0.levels";
const FILLED = "labels[0].cells must have ranges that fill their file, from byte 0 on";
const KIND = "labels[0].cells[0].levels[0] must have an offset exactly if it is a stream";
const ALONE = "labels[0].cells[0].levels must be one stream, in a file of the label's own";
const first = streams.labels[0]?.cells[0]?.levels[0];

test.each<[string, unknown, string, Document?]>([
  [LEVELS, [], "labels[0].cells[0].levels must be a list of at least 1"],
  ["labels.1.id", 0, "same id"],
  ["labels.1.cells.0.id", 0, "cells have the same id twice"],
  ["labels.0.cells", [], "labels[0].cells must be a list of at least 1"],
  ["labels.0.cells.0.bounds", [1, 0, 0, 0, 0, 0], "labels[0].cells[0].bounds has a least above its most"],
  ["labels.0.cells.0.bounds", [1, 0], "labels[0].cells[0].bounds must be a list of 6"],
  [
    "labels.0.cells.0.points",
    base64([1, 2, 3, 4, 5]),
    "labels[0].cells[0].points must have four bytes a point",
  ],
  ["labels.0.cells.0.points", "AAAA=", "labels[0].cells[0].points must be a list of bytes in base64"],
  ["labels.0.weight", -1, "labels[0].weight must be a number from 0 on"],
  ["labels.0.color", "red", "labels[0].color must be a colour as #rrggbb"],
  [`${LEVELS}.0.sha256`, "12", "labels[0].cells[0].levels[0].sha256 must be a text of the first digits"],
  [`${LEVELS}.0.bytes`, [], "labels[0].cells[0].levels[0].bytes must be a list of at least 1"],
  [`${LEVELS}.0.bytes`, [1.5], "labels[0].cells[0].levels[0].bytes[0] must be a whole number from 1 on"],
  [`${LEVELS}.0.counts`, [1, 2], "labels[0].cells[0].levels[0] must have a number a level"],
  [
    `${LEVELS}.0.weights`,
    [1],
    "labels[0].cells[0].levels[0] must be one level without a weight, as it is a file",
  ],
  [`${LEVELS}.0.format`, "ksplat", 'must be "stream" or "spz" or "ply"'],
  [`${LEVELS}.0.refine`, "REPLACE", "labels[0].cells[0].levels[0] has nothing to replace"],
  [`${LEVELS}.1.refine`, null, 'levels[1].refine must be "REPLACE"'],
  [`${LEVELS}.0.offset`, 0, KIND],
  [`${LEVELS}.0.sha256`, "0123456", "labels[0].cells[0].levels[0].sha256 must be"],
  ["labels.0.quality.fidelity.mean", [0], "labels[0].quality.fidelity must have a number a level"],
  ["labels.0.quality.fidelity.bound", [0], "labels[0].quality.fidelity must have a number a level"],
  ["labels.0.quality.fidelity.bound", 3, "labels[0].quality.fidelity.bound must be a list"],
  ["labels.0.quality.fidelity.levels.1", 1, "labels[0].quality.fidelity.levels must rise"],
  ["labels.0.quality.fidelity.levels.1", 9, "labels[0].quality.fidelity.levels must rise"],
  ["labels.0.quality.fidelity.mean.1", 2, "labels[0].quality.fidelity.mean[1] must be a number from -1 to 1"],
  ["target.quality", "psnr", 'target.quality must be "fidelity" or "ssim"'],
  ["target.value", null, "target.value must be a number"],
  ["frame.axes", "rdf", 'frame.axes must be "rub"'],
  ["frame.metersPerUnit", 0, "frame.metersPerUnit must be a number above 0"],
  ["labels", {}, "labels must be a list"],
  ["format", "other", "sagesplat-bundle"],
  ["pack", 3, "pack must be an object", packed],
  ["pack.uri", "../scene.pack", "pack.uri must be", packed],
  ["pack.bytes", 1, "pack.order must name levels that fill pack.bytes", packed],
  ["pack.order", [[0]], "pack.order[0] must be a list of 2", packed],
  ["pack.order.0", [9, 1], "pack.order must name levels", packed],
  ["pack.order.0", [0, 9], "pack.order must name levels", packed],
  ["pack.order.0", [0, 2], "pack.order must name levels", packed],
  [`${LEVELS}.0.offset`, undefined, KIND, streams],
  [`${LEVELS}.0.sha256`, "01234567", "levels[0].sha256 must have as many digits for each level", streams],
  [`${LEVELS}.0.format`, "spz", KIND, streams],
  [`${LEVELS}.0.offset`, 1, FILLED, streams],
  [`${LEVELS}.0.offset`, 0.5, "levels[0].offset must be a whole number from 0 on", streams],
  ["labels.0.cells.1.levels.0.offset", 1, FILLED, parted],
  ["labels.0.cells", parted.labels[0]?.cells.slice(1), FILLED, parted],
  ["labels.0.cells.0.levels.0.bytes.0", 1, FILLED, parted],
  [LEVELS, [first, first], "labels[0].cells[0].levels must be ranges without gaps", streams],
  [LEVELS, [first, { ...first, uri: "chunks/other.sgst" }], ALONE, streams],
  [LEVELS, [first, plain.labels[0]?.cells[0]?.levels[0]], ALONE, streams],
  [`${LEVELS}.1.offset`, 1, FILLED, replacing],
  [`${LEVELS}.1.uri`, "chunks/other.sgst", ALONE, replacing],
  [`${LEVELS}.0.weights`, [0.5], "levels must all have a weight, or none", replacing],
  [`${LEVELS}.0.weights`, [0, 0.5, 1.5], "levels[0].weights[2] must be a number from 0 to 1", streams],
  ["labels.1.cells.0.levels.0.uri", first?.uri, ALONE.replace("[0]", "[1]"), streams],
])("%s = %j", (path, value, message, document = plain) => {
  expect(refusal(document, path, value)).toContain(message);
});

test("no JSON, and JSON of other kinds", () => {
  expect(complaint(() => parseManifest("{"))).toContain("not JSON");
  for (const text of ["null", "[]", "3"])
    expect(complaint(() => parseManifest(text))).toContain("must be an object");
  const infinite = JSON.stringify(plain).replace('"floor":-1', '"floor":1e999');
  expect(complaint(() => parseManifest(infinite))).toContain("frame.floor must be a number");
});

test("many things wrong are named up to a few", () => {
  const message = complaint(() => parseManifest(`{"format":"sagesplat-bundle","version":${VERSION}}`));
  expect(message).toContain("generator is missing; name is missing");
  expect(message).toMatch(/and \d+ more/);
});

test.each([
  ["quality", "ssim", 'quality must be "fidelity"'],
  ["extent", "far", "extent must be a number"],
  ["views", [[1]], "views must be a list of 8"],
  ["focal", 0, "focal must be a number above 0"],
  ["screens", [1], "screens must be a list of 2"],
  ["screens", [2, 0.5], "screens must be from the smaller to the larger"],
  ["levels", undefined, "levels must say how many"],
  ["views.0", [1], "views and photos must have columns of equal length"],
  ["views.0.1", 0.5, "views[0][1] must be a whole number"],
  ["labels.0.cells.0.factors", [5000], "labels[0].cells[0] has lists"],
  ["labels.0.cells.0.factors.0", 2e6, "labels[0].cells[0] has factors, shares or corrections out of range"],
  ["labels.0.cells.0.corrections", [1], "labels[0].cells[0] has lists"],
  ["labels.0.cells.0.id", -1, "labels have models of cells for fidelity, of the whole label for ssim"],
  ["labels.0.cells.0.rows", [0, 99], "labels[0].cells[0] has lists"],
  ["labels.0.cells.0.rows.1", 99, "labels[0].cells[0] has lists"],
  ["labels.0.cells.0.terms.0", [1], "labels[0].cells[0] has lists"],
  ["labels.0.cells.0.terms.0.0", 1e10, "labels[0].cells[0] has values out of range"],
  ["labels.0.cells.0.ladder", [1], "labels[0].cells[0] has lists"],
  ["labels.0.cells.0.units", [0], "labels[0].cells[0].units[0] must be a"],
  ["labels.0.cells.0.offsets.0", 90_001, "labels[0].cells[0] has values out of range"],
  ["labels.0.cells.0.offsets", [0], "labels[0].cells[0] has lists"],
  [
    "labels.0.cells.0.curves",
    [{ level: 1, params: [1, 0, 0, 1, 1, 0, 0, 1, 0], range: [0, 1], median: 1 }],
    "labels[0].cells[0] has lists",
  ],
  ["labels.0.cells.0.logDistances.0", 1e6, "labels[0].cells[0] has values out of range"],
  ["labels.0.cells.0.levels", [2, 1], "labels[0].cells[0].levels must rise"],
  ["labels.0.lengths", [1, 0, 1, 1], "labels[0].lengths[1]"],
  ["labels.0.lengths", [1, 1, 1], "labels[0].lengths must be a list of 4"],
  ["labels.0.thresholds", [1, 2], "labels[0] has lists"],
  ["labels.0.slopes", [1, 2], "labels[0] has lists"],
  ["labels.0.thresholds.1", 1e10, "labels[0] has thresholds or slopes out of range"],
  ["labels.0.slopes.1", -1e10, "labels[0] has thresholds or slopes out of range"],
  ["labels.0.targets.1", 3000, "labels[0].targets must rise"],
  ["labels.0.targets.4", 10_001, "labels[0].targets must rise"],
  ["labels.0.status", "pooled", "labels[0].status must be"],
])("promises: %s = %j", (path, value, message) => {
  const parsed = (json: string) => parsePromises(json, "p.json", "fidelity");
  expect(parsed(JSON.stringify(promises))).toEqual(promises);
  expect(complaint(() => parsed(changed(promises, path, value)))).toContain(message);
});

const { ladder: _, terms: __, ...cell } = promises.labels[0].cells[0];
const K = cell.offsets.length;
const [units, values] = [Array(K).fill(1e-3), Array(K).fill(cell.rows)];
const whole = { ...cell, id: -1, levels: cell.offsets.map((_: number, k: number) => k + 1), units, values };
const ssim = { ...promises, quality: "ssim", labels: [{ ...promises.labels[0], cells: [whole] }] };

test.each([
  ["values", [], "labels[0].cells[0] has lists"],
  ["values.0", [1], "labels[0].cells[0] has lists"],
  ["values.0.0", 1e10, "labels[0].cells[0] has values out of range"],
  ["units.0", 0, "labels[0].cells[0].units[0] must be a number from"],
  ["units", [1], "labels[0].cells[0] has lists"],
  ["values", undefined, "labels[0].cells[0] has lists"],
  ["levels", [1, 2, 3, 4, 5], "labels[0].cells[0] has lists"],
])("promises of ssim: %s = %j", (path, value, message) => {
  const parsed = (json: string) => parsePromises(json, "p.json", "ssim");
  expect(parsed(JSON.stringify(ssim))).toEqual(ssim);
  expect(complaint(() => parsed(changed(ssim, `labels.0.cells.0.${path}`, value)))).toContain(message);
});

const coded = (JSON.parse(vectors).cases as { promises: { quality: string; numbers: string } }[]).find(
  (one) => one.promises.quality === "fidelity",
)?.promises;
const turned = Buffer.from(coded?.numbers ?? "", "base64")
  .reverse()
  .toString("base64");

test.each<[string, unknown]>([
  ["numbers", "AAAA"],
  ["numbers", ""],
  ["numbers", "?"],
  ["numbers", null],
  ["numbers", turned],
  ["numbers", `${coded?.numbers.replaceAll("=", "A")}AAAA`],
  ["views.0", 2 ** 22 + 1],
  ["views.0", -1],
  ["views.0", 1e300],
  ["views.0", 0.5],
])("numbers that are damaged: %s = %j", (path, value) => {
  const parsed = (json: string) => parsePromises(json, "p.json", "fidelity");
  expect(parsed(JSON.stringify(coded)).views).toHaveLength(8);
  expect(complaint(() => parsed(changed(coded, path, value)))).toContain("p.json: its numbers are damaged");
});

describe("loading", () => {
  const load = async (prepare: (network: Network) => void) => {
    const clock = new VirtualClock();
    const network = new Network(clock);
    const manifest = bundle(network, { labels: 1, bytes: 100 });
    network.files.set("manifest.json", new TextEncoder().encode(JSON.stringify(documentOf(manifest))));
    prepare(network);
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
