// Damages coded streams and decodes them: node test/fuzz.report.mjs SECONDS [SEED] [FOLDER with .sgst files]
// prints one line of JSON; exit status 1 for a finding. Golden streams are always among them.

import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { runnerImport } from "vite";

const [seconds, seed = "1", folder] = process.argv.slice(2);
if (!(Number(seconds) > 0)) throw new Error("give the seconds to run");
const root = fileURLToPath(new URL("..", import.meta.url));
const { module } = await runnerImport(join(root, "test/fuzz.ts"), { root, configFile: false });

const golden = JSON.parse(readFileSync(join(root, "../tests/data/streams.json"), "utf8"));
const bytes = (text) => new Uint8Array(Buffer.from(text, "base64"));
const streams = golden.map(({ content, palette = "" }) =>
  Uint8Array.of(...bytes(palette), ...bytes(content)),
);
for (const name of folder ? readdirSync(folder) : []) {
  if (name.endsWith(".sgst")) streams.push(new Uint8Array(readFileSync(join(folder, name))));
}
const before = process.memoryUsage().rss;
const found = module.fuzz(streams, Number(seed), { seconds: Number(seconds), longest: 1000 });
const grown = Math.round((process.memoryUsage().rss - before) / 1e6);
console.log(JSON.stringify({ streams: streams.length, seed: Number(seed), ...found, grownMB: grown }));
process.exit(found.wrong.length ? 1 : 0);
