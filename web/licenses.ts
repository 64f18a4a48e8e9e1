/// <reference types="node" />
import { existsSync, readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import type { Plugin } from "vite";

interface Package {
  readonly name: string;
  readonly version: string;
  readonly license: string;
  readonly dependencies?: Readonly<Record<string, string>>;
}

const SPARK = "@sparkjsdev/spark";
/** Of the Rust crates in Spark's WebAssembly, which npm knows nothing of; tests/test_viewer_licenses.py checks it. */
const notices = readFileSync(join(import.meta.dirname, "wasm-notices.txt"), "utf8");
const modules = join(import.meta.dirname, "node_modules");

function readPackage(name: string): Package {
  return JSON.parse(readFileSync(join(modules, name, "package.json"), "utf8"));
}

/** A package and what it carries inside itself: Spark ships with its dependencies built in. */
function withDependencies(name: string): string[] {
  return [name, ...Object.keys(readPackage(name).dependencies ?? {}).flatMap(withDependencies)];
}

function licenseOf(name: string): string {
  const folder = join(modules, name);
  const { version, license } = readPackage(name);
  const file = readdirSync(folder).find((entry) => /^licen[cs]e/i.test(entry));
  const text = file ? readFileSync(join(folder, file), "utf8").trim() : "";
  return `${name} ${version}\nLicence: ${license}\n\n${text}\n`;
}

/** Writes THIRD_PARTY_LICENSES.txt of the packages that really are in the bundle. */
export function licenses(): Plugin {
  return {
    name: "third-party-licenses",
    generateBundle(_, bundle) {
      const names = new Set<string>();
      for (const file of Object.values(bundle)) {
        for (const id of file.type === "chunk" ? file.moduleIds : []) {
          const name = /node_modules\/((?:@[^/]+\/)?[^/]+)/.exec(id)?.[1];
          if (!name || !existsSync(join(modules, name))) continue;
          for (const carried of withDependencies(name)) names.add(carried);
        }
      }
      const rule = `\n${"-".repeat(80)}\n\n`;
      this.emitFile({
        type: "asset",
        fileName: "THIRD_PARTY_LICENSES.txt",
        source: [...[...names].sort().map(licenseOf), ...(names.has(SPARK) ? [notices] : [])].join(rule),
      });
    },
  };
}
