/** Damages coded streams and decodes them as the viewer does. */

import { Palette } from "../src/core/palette";
import { StreamDecoder } from "../src/core/stream";
import { Packing, type Part } from "../src/view/packing";
import { seeded } from "./simulate";

/** What damaged streams led to. */
export interface Findings {
  tried: number;
  decoded: number; // without a complaint
  refused: number;
  slowest: number; // ms
  largest: number; // bytes of parts that one stream led to, over what its bytes may hold: at most 1
  wrong: string[]; // everything else: one line each
}

const PER_BYTE = 128; // Gaussians in a byte, at most
const WORDS = 56 + 2 + 1; // bytes of a Gaussian of degree 3, with two opacities, the second one sent later
const [SHORT, LONGER] = [900, 20_000]; // bytes of a piece of a longer stream, usually and now and then

/** When to stop, and what is a finding. */
export interface Limits {
  readonly seconds?: number; // to run
  readonly most?: number; // streams to damage
  readonly longest?: number; // ms that a stream may take
}

/** Damages streams, the same ones for a seed. */
export function fuzz(
  streams: readonly Uint8Array[],
  seed: number,
  { seconds = Infinity, most = Infinity, longest = Infinity }: Limits,
): Findings {
  const random = seeded(seed);
  const below = (n: number) => Math.floor(random() * n);
  const found: Findings = { tried: 0, decoded: 0, refused: 0, slowest: 0, largest: 0, wrong: [] };
  const begun = performance.now();
  const { stackTraceLimit } = Error;
  Error.stackTraceLimit = 0; // most are refused
  while (found.tried < most && found.wrong.length < 10) {
    if (found.tried % 256 === 0 && performance.now() - begun > 1000 * seconds) break;
    const stream = streams[below(streams.length)] as Uint8Array;
    const piece = stream.subarray(0, 50 + below(below(50) ? SHORT : LONGER));
    attempt(damaged(piece, below), below, longest, found);
  }
  Error.stackTraceLimit = stackTraceLimit;
  return found;
}

/** A copy with some bytes changed, cut out, doubled, or from another place. */
function damaged(stream: Uint8Array, below: (n: number) => number): Uint8Array {
  let bytes = stream.slice();
  for (let k = below(4); k >= 0 && bytes.length; k--) {
    const at = below(4) ? below(bytes.length) : below(Math.min(60, bytes.length)); // often in the header
    const size = 1 + below(Math.min(8, bytes.length));
    const kind = below(8);
    if (kind < 3) bytes[at] = below(256);
    else if (kind < 5) bytes[at] = (bytes[at] as number) ^ (1 << below(8));
    else if (kind === 5) bytes.copyWithin(at, below(bytes.length), below(bytes.length));
    else if (kind === 6) bytes = Uint8Array.of(...bytes.subarray(0, at), ...bytes.subarray(at + size));
    else bytes = Uint8Array.of(...bytes.subarray(0, at + size), ...bytes.subarray(at));
  }
  return bytes;
}

function attempt(bytes: Uint8Array, below: (n: number) => number, longest: number, found: Findings): void {
  const begun = performance.now();
  const parts: Part[] = [];
  const line = (what: string) => `${what}: ${Buffer.from(bytes).toString("base64")}`;
  try {
    const start = endOfPalette(bytes);
    const palette = start ? new Palette(bytes.subarray(0, start)) : null;
    const stream = bytes.subarray(start);
    const decoder = new StreamDecoder(new Packing(), palette);
    const cut = below(3) ? stream.length : below(stream.length + 1);
    for (const piece of [stream.slice(0, cut), stream.slice(cut)]) parts.push(...decoder.push(piece));
    found.decoded += 1;
  } catch (error) {
    found.refused += 1;
    const is = error as Error;
    if (is.constructor !== Error || /\n/.test(is.message)) found.wrong.push(line(String(is)));
  }
  found.tried += 1;
  const ms = performance.now() - begun;
  found.slowest = Math.max(found.slowest, ms);
  if (ms > longest) found.wrong.push(line(`${Math.round(ms)} ms`));
  const size = parts.reduce((sum, part) => sum + sizeOf(part), 0) / (PER_BYTE * WORDS * bytes.length || 1);
  found.largest = Math.max(found.largest, size);
  if (size > 1) found.wrong.push(line("more than its bytes may hold"));
}

/** Where the palette ends that a file begins with, if there is one; damage may move it. */
export function endOfPalette(file: Uint8Array): number {
  const view = new DataView(file.buffer, file.byteOffset, file.byteLength);
  if (file.length < 16 || view.getUint32(0) !== 0x53475350) return 0;
  return Math.min(16 + view.getUint32(12, true), file.length);
}

function sizeOf({ splats, harmonics, opacities, earlier }: Part): number {
  const words = [...harmonics.values()].reduce((sum, { byteLength }) => sum + byteLength, splats.byteLength);
  return words + (opacities?.byteLength ?? 0) + (earlier?.byteLength ?? 0);
}
