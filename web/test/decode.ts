/** How fast coded streams are decoded to what the GPU reads. */

import { HEADER_BYTES, readHeader } from "../src/core/header";
import { Palette } from "../src/core/palette";
import { StreamDecoder } from "../src/core/stream";
import { Packing } from "../src/view/packing";
import { endOfPalette } from "./fuzz";

/** The streams of a file, which lie one after the other, and the palette before them. */
export function streamsOf(file: Uint8Array): { palette: Palette | null; stream: Uint8Array }[] {
  const found: { palette: Palette | null; stream: Uint8Array }[] = [];
  let at = endOfPalette(file);
  const palette = at ? new Palette(file.subarray(0, at)) : null;
  const number = () => {
    let value = 0;
    for (let shift = 0; ; shift += 7) {
      const byte = file[at++] as number;
      value |= (byte & 127) << shift;
      if (byte < 128) return value;
    }
  };
  while (at < file.length) {
    const start = at;
    const { levels, twoOpacities } = readHeader(file.subarray(at));
    at += HEADER_BYTES;
    for (let level = 0; level < levels; level++) {
      number();
      const size = number(); // before `at` is read: it moves
      at += Number(twoOpacities) + size;
    }
    found.push({ palette, stream: file.subarray(start, at) });
  }
  return found;
}

/** Millions of Gaussians a second: of the first round, the best one and the median. */
export function decodeSpeed(files: readonly Uint8Array[], rounds: number): Record<string, number> {
  const times: number[] = [];
  let count = 0;
  for (let round = 0; round < rounds; round++) {
    const begun = performance.now();
    count = 0;
    for (const { palette, stream } of files.flatMap(streamsOf)) {
      for (const part of new StreamDecoder(new Packing(), palette).push(stream)) count += part.count;
    }
    times.push(performance.now() - begun);
  }
  const [first] = times as [number];
  times.sort((a, b) => a - b);
  const speed = (ms: number) => Math.round(count / ms / 10) / 100;
  return { count, first: speed(first), best: speed(times[0] ?? 0), median: speed(times[rounds >> 1] ?? 0) };
}
