import { PackedSplats } from "@sparkjsdev/spark";
import type { Format } from "../types";
import { ENCODING, HARMONICS, type Part, WORDS } from "./packing";
import { flipped } from "./ply";

const ROW = 2048; // splats per row of Spark's textures: arrays hold complete rows
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
  const part = { count, splats: packed.packedArray.slice(0, count * 4), harmonics, opacities: null };
  packed.dispose();
  return part;
}

/**
 * Concatenates parts into one set of splats. A part without harmonics gets zeros.
 *
 * @param finish - changes the words of all of them, before they are uploaded
 */
export function joined(
  parts: readonly Part[],
  finish: (words: Uint32Array) => void = () => {},
): PackedSplats {
  const count = parts.reduce((sum, part) => sum + part.count, 0);
  const rows = Math.max(1, Math.ceil(count / ROW)) * ROW;
  const packedArray = new Uint32Array(rows * 4);
  const extra: Record<string, Uint32Array> = {};
  let start = 0;
  for (const part of parts) {
    packedArray.set(part.splats, start * 4);
    for (const [key, words] of part.harmonics) {
      extra[key] ??= new Uint32Array(rows * WORDS[key]);
      extra[key].set(words, start * WORDS[key]);
    }
    start += part.count;
  }
  finish(packedArray);
  return new PackedSplats({ packedArray, numSplats: count, extra, splatEncoding: ENCODING });
}
