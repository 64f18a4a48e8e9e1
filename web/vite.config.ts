import { defineConfig } from "vite";
import { licenses } from "./licenses.ts";

/** The page of a bundle, which the Python package brings. */
export default defineConfig({
  base: "./",
  plugins: [licenses()],
  build: {
    outDir: "../src/sagesplat/viewer/static",
    emptyOutDir: true,
    sourcemap: false,
    target: "es2022",
    modulePreload: false,
    assetsInlineLimit: 0,
    chunkSizeWarningLimit: 4000,
  },
});
