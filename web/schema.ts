/// <reference types="node" />
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { compile, type JSONSchema } from "json-schema-to-typescript";
import type { Plugin } from "vite";

const SOURCE = join(import.meta.dirname, "../src/sagesplat/viewer/manifest.schema.json");
export const TYPES = join(import.meta.dirname, "src/documents.ts");
const BANNER =
  "/** The documents of a bundle. Generated from src/sagesplat/viewer/manifest.schema.json by `npm run build`. */\n";

/** The TypeScript source of the types that the schema describes. */
export async function typesOfSchema(): Promise<string> {
  const schema = JSON.parse(readFileSync(SOURCE, "utf8"), (_key, value) => {
    if (typeof value !== "object" || Array.isArray(value)) return value;
    const { minItems, maxItems, ...others } = value;
    if (minItems !== undefined && minItems !== maxItems) return others; // a list, not a tuple with a rest
    // comments of a field beside a reference would make a type of its own
    return "$ref" in value ? { $ref: value.$ref } : value;
  }) as JSONSchema;
  const options = { additionalProperties: false, unreachableDefinitions: true, bannerComment: BANNER };
  const source = await compile(schema, "Manifest", { ...options, style: { printWidth: 110 } });
  return source
    .replace(/\n *\* This interface was referenced by [^\n]*\n *\* via the `definition`[^\n]*/g, "")
    .replace(/\n *\* @m\w+Items \d+/g, "")
    .replace(/\/\*\*(\n *\*)*\n *\*\/\n */g, "")
    .replace(/\/\*\*\n *\* ([^\n]*)(\n *\*)*\n *\*\//g, "/** $1 */");
}

/**
 * Brings the types up to date when the viewer is built, and leaves descriptions out of the schema that it holds,
 * but for those of patterns, which messages say.
 */
export function schema(): Plugin {
  return {
    name: "schema",
    enforce: "pre",
    async buildStart() {
      if (!process.env.VITEST) writeFileSync(TYPES, await typesOfSchema());
    },
    load(id) {
      if (!id.endsWith(".schema.json")) return null;
      const withoutProse = (_key: string, value: unknown) => {
        if (typeof value !== "object" || value === null || Array.isArray(value) || "pattern" in value)
          return value;
        const { description, ...others } = value as Record<string, unknown>;
        return typeof description === "string" ? others : value;
      };
      return JSON.stringify(JSON.parse(readFileSync(id, "utf8"), withoutProse));
    },
  };
}
