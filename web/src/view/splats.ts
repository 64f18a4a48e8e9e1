import { PackedSplats } from "@sparkjsdev/spark";
import type { Format } from "../types";
import { ENCODING, HARMONICS, type Part, WORDS } from "./packing";
import { flipped } from "./ply";

/** Decodes a file of splats in Spark's worker; rejects for an invalid one. */
export async function decodePart(bytes: Uint8Array, format: Format): Promise<Part> {
  const fileBytes = format === "ply" ? flipped(bytes) : bytes;
  const packed = new PackedSplats({ fileBytes, splatEncoding: ENCODING });
  await packed.initialized;
  const count = packed.numSplats;
  if (!packed.packedArray || count === 0) throw new Error("no splats in it");
  const harmonics = new Map<(typeof HARMONICS)[number], Uint32Array>();
  for (const key of HARMONICS) {
    const words = packed.extra[key];
    if (words instanceof Uint32Array) harmonics.set(key, words.slice(0, count * WORDS[key]));
  }
  const splats = packed.packedArray.slice(0, count * 4);
  const part = { count, splats, harmonics, opacities: null };
  packed.dispose();
  return part;
}
