import { defineConfig } from "vitest/config";
import { licenses } from "./licenses.ts";
import { schema } from "./schema.ts";
import { spark } from "./spark.ts";
import { three } from "./three.ts";

/** The page of a bundle, which the Python package brings. */
export default defineConfig({
  base: "./",
  plugins: [spark(), three(), schema(), licenses()],
  build: {
    outDir: "../src/sagesplat/viewer/static",
    emptyOutDir: true,
    sourcemap: false,
    target: "es2022",
    modulePreload: false,
    assetsInlineLimit: 0,
    chunkSizeWarningLimit: 4000,
  },
  test: { testTimeout: 300_000 }, // a slow machine fails no test
});
