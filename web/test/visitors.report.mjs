// Visitors of a bundle and what they ask for: node test/visitors.report.mjs BUNDLE OUT.json [--visits N] [--seed S]
// [--scale K]. Time is simulated, so results repeat exactly. docs/scaling.md says what they are for.

import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import { gzipSync } from "node:zlib";
import { runnerImport } from "vite";

const { values, positionals } = parseArgs({
  allowPositionals: true,
  options: {
    visits: { type: "string", default: "16" },
    seed: { type: "string", default: "1" },
    scale: { type: "string", default: "1" },
  },
});
const [bundle, out] = positionals;
if (!bundle || !out) throw new Error("give a bundle's folder and a file to write");
const [visits, seed, scale] = [values.visits, values.seed, values.scale].map(Number);
const root = fileURLToPath(new URL("..", import.meta.url));
const { module: sim } = await runnerImport(join(root, "test/visitors.ts"), { root, configFile: false });

const original = readFileSync(join(bundle, "manifest.json"), "utf8");
const manifest = sim.resized(original, scale);
const promises = manifest.promises.fidelity?.uri;

/** Bytes that a server sends, which packs text and nothing else. */
const wire = (uri) => {
  const content = readFileSync(join(bundle, uri));
  return /\.(css|html|js|json)$/.test(uri) ? gzipSync(content, { level: 6 }).length : content.length;
};
const html = readFileSync(join(bundle, "index.html"), "utf8");
// what the page names; the rest comes when it is needed: WebAssembly for more splats than these bundles have
const page = ["index.html", ...new Set(html.match(/\bassets\/[\w.-]+/g))];
if (existsSync(join(bundle, "poster.jpg"))) page.push("poster.jpg");
const served = page.map((uri) => ({ uri, wire: wire(uri) }));
if (promises) {
  served.push({ uri: promises, wire: wire(promises), text: readFileSync(join(bundle, promises), "utf8") });
}

const chunks = new Map(); // a file holds the levels of one cell, or of many
for (const [label, { cells }] of manifest.labels.entries()) {
  for (const { uri, bytes, offset = 0 } of cells.flatMap(({ levels }) => levels)) {
    if (!bytes) continue;
    const size = Math.max(offset + bytes, chunks.get(uri)?.bytes ?? 0);
    chunks.set(uri, { uri, bytes: size, kind: "chunk", label });
  }
}
const files = [
  ...served.map(({ uri, wire }) => ({ uri, bytes: wire, kind: uri === promises ? "promises" : "viewer" })),
  { uri: "manifest.json", bytes: wire("manifest.json"), kind: "manifest" },
  ...(manifest.pack ? [{ uri: manifest.pack.uri, bytes: manifest.pack.bytes, kind: "pack" }] : []),
  ...chunks.values(),
];
const indexOf = new Map(files.map(({ uri }, i) => [uri, i]));
// text comes unpacked in the simulation: what came of it counts by its share
const raw = new Map([
  ["manifest.json", sim.textOf(manifest).length],
  ...(promises ? [[promises, readFileSync(join(bundle, promises)).length]] : []),
]);
const sent = ({ uri, bytes }) => {
  const file = files[indexOf.get(uri)];
  return Math.round((bytes * file.bytes) / (raw.get(uri) ?? file.bytes));
};
/** ms, file, and the bytes that came unless it was all of it; then those of the range that was asked for. */
const row = (one) => {
  const index = indexOf.get(one.uri);
  const came = sent(one);
  if (one.asked !== undefined) return [one.ms, index, came, one.asked];
  return came === files[index].bytes ? [one.ms, index] : [one.ms, index, came];
};

const profiles = [];
for (const profile of sim.PROFILES) {
  const found = [];
  for (const [i, seconds] of sim.stays(visits, seed).entries()) {
    const requests = await sim.visit(manifest, served, profile, seconds, 1000 * seed + i);
    found.push({
      seconds: Number(seconds.toFixed(2)),
      requests: requests.map(row),
    });
  }
  profiles.push({ name: profile.name, mbit: profile.mbit, latencyMs: sim.LATENCY, visits: found });
}
const { metersPerUnit, scale: known } = manifest.frame;
const cameras = manifest.cameras.map(({ position }) => position.map((x) => Number(x.toFixed(3))));
const result = {
  format: "sagesplat-visits",
  version: 1,
  scene: manifest.name,
  scale,
  seed,
  labels: manifest.labels.map(({ name }) => name),
  totals: manifest.totals,
  frame: { up: manifest.frame.up, metersPerUnit, scale: known },
  photos: manifest.cameras.length,
  cameras,
  files,
  profiles,
};
const text = JSON.stringify(result).replaceAll(/\{"(uri|name|seconds)"/g, "\n$&");
writeFileSync(out, `${text}\n`);
