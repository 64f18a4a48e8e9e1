/// <reference types="node" />
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { defineConfig, type Plugin } from "vite";
import { licenses } from "./licenses.ts";
import { schema } from "./schema.ts";
import { spark } from "./spark.ts";
import { three } from "./three.ts";

function ownLicense(): Plugin {
  const source = readFileSync(join(import.meta.dirname, "..", "LICENSE"), "utf8");
  return {
    name: "license",
    generateBundle() {
      this.emitFile({ type: "asset", fileName: "LICENSE", source });
    },
  };
}

/** The npm package: one module that brings all that it needs. */
export default defineConfig({
  plugins: [spark(true), three(), schema(), licenses(), ownLicense()],
  build: {
    outDir: "dist",
    target: "es2022",
    lib: { entry: "src/create.ts", formats: ["es"], fileName: "sagesplat-viewer" },
    chunkSizeWarningLimit: 6000,
  },
});
