// How fast streams are decoded, in millions of Gaussians a second: node test/decode.report.mjs FOLDER [ROUNDS]
// [PAGE.html], which is a page to write that measures the same in a browser, as its title: itself, and two workers.

import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "vite";

const [folder, rounds = "100", page] = process.argv.slice(2);
if (!folder) throw new Error("give a folder with .sgst files");
const entry = fileURLToPath(new URL("decode.ts", import.meta.url));
const lib = { entry, formats: ["iife"], name: "decoding" };
const options = { write: false, target: "es2022", lib };
const [{ output }] = await build({ configFile: false, logLevel: "error", build: options }); // as the viewer is built
const [{ code }] = output;

const names = readdirSync(folder).filter((name) => name.endsWith(".sgst"));
const streams = names.map((name) => readFileSync(join(folder, name)));
if (page) {
  const data = JSON.stringify(streams.map((stream) => stream.toString("base64")));
  writeFileSync(
    page,
    `<script type="module">
${code}
const streams = ${data}.map((t) => Uint8Array.from(atob(t), (c) => c.charCodeAt(0)));
const speed = (workers) => decoding.decodeSpeed(streams, ${rounds}, workers);
document.title = JSON.stringify({ page: await speed(0), workers: await speed(2) });
</script>
`,
  );
} else {
  const { decodeSpeed } = new Function(`${code};return decoding`)();
  console.log(JSON.stringify(await decodeSpeed(streams, Number(rounds), 0)));
}
