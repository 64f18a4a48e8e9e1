// Simulates how a bundle arrives over slow links: node test/network.report.mjs BUNDLE OUT
// writes network.json, curve.csv and walk.csv into OUT. Time is simulated, so results repeat exactly.

import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { runnerImport } from "vite";

const [bundle, out] = process.argv.slice(2);
if (!bundle || !out) throw new Error("give a bundle's folder and a folder to write to");
const root = fileURLToPath(new URL("..", import.meta.url));
const { module: sim } = await runnerImport(join(root, "test/network.ts"), { root, configFile: false });

const manifest = readFileSync(join(bundle, "manifest.json"), "utf8");
const promises = readFileSync(join(bundle, JSON.parse(manifest).promises.fidelity.uri), "utf8");
const documents = { manifest, promises };
const round = (value, digits) => Number(value.toFixed(digits));

/** Seconds, bytes and SSIM at the first sample of a kind. */
const at = (curve, is) => {
  const { ms, bytes, ssim, takes } = curve.find(is) ?? curve.at(-1);
  return { seconds: round(ms / 1000, 2), bytes, ssim: round(ssim, 3), takes };
};

const links = {};
const curves = ["mbit,connections,way,seconds,bytes,ssim"];
for (const connections of [6, Infinity]) {
  for (const mbit of [2, 10, 50]) {
    const line = { mbit, connections };
    const ways = {
      streamed: await sim.streamed(documents, line, {}),
      "fidelity 0.95": await sim.streamed(documents, line, { mode: "target", target: 0.95 }),
      "file order": await sim.fileOrder(documents, line),
      "one file": sim.oneFile(documents, line),
    };
    const name = `${mbit} Mbit/s, ${connections === 6 ? "6 connections" : "HTTP/2"}`;
    links[name] = {};
    for (const [way, curve] of Object.entries(ways)) {
      for (const { ms, bytes, ssim } of curve) {
        curves.push([mbit, connections, way, round(ms / 1000, 3), bytes, round(ssim, 4)].join());
      }
      links[name][way] = {
        first: at(curve, ({ ssim }) => ssim > 0),
        everythingAtItsSmallest: at(curve, ({ whole }) => whole),
        seconds95: round(sim.reaches(curve, 0.95), 2),
        seconds99: round(sim.reaches(curve, 0.99), 2),
        end: at(curve, () => false),
      };
    }
  }
}

const walk = await sim.walked(documents, { mbit: 10, connections: 6 }, { mode: "target", target: 0.95 });
const lines = walk.map((s) => [s.second, s.bytes, s.count, round(s.ssim, 4), round(s.full, 4)].join());
const mean = (of) => round(walk.reduce((sum, step) => sum + of(step), 0) / walk.length, 4);
const totals = JSON.parse(manifest).totals;
const result = {
  latencyMs: 100,
  totals,
  documents: { manifest: manifest.length, promises: promises.length },
  links,
  walk: {
    views: walk.length,
    bytes: walk.at(-1).bytes,
    ofFullScene: round(walk.at(-1).bytes / totals.bytes, 3),
    meanCount: mean((s) => s.count),
    meanSsim: mean((s) => s.ssim),
    meanSsimOfFullScene: mean((s) => s.full),
  },
};
mkdirSync(out, { recursive: true });
writeFileSync(join(out, "network.json"), `${JSON.stringify(result, null, 1)}\n`);
writeFileSync(join(out, "curve.csv"), `${curves.join("\n")}\n`);
writeFileSync(join(out, "walk.csv"), `second,bytes,count,ssim,ssim_full\n${lines.join("\n").trim()}\n`);
