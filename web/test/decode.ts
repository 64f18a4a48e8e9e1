/** How fast coded streams are decoded to what the GPU reads, as the viewer does it. */

import { HEADER_BYTES, readHeader } from "../src/core/header";
import { Decoders, type PaletteBytes } from "../src/view/decoding";
import StreamWorker from "../src/view/decoding.worker?worker&inline";
import { endOfPalette } from "./fuzz";

interface Stream {
  readonly palette: PaletteBytes | undefined;
  readonly increments: readonly Uint8Array[]; // levels that have Gaussians
}

/** The streams of a file, which lie one after the other, and the palette before them. */
function streamsOf(file: Uint8Array, name: number): Stream[] {
  const found: Stream[] = [];
  let at = endOfPalette(file);
  const palette = at ? { key: String(name), bytes: file.slice(0, at) } : undefined;
  const number = () => {
    let value = 0;
    for (let shift = 0; ; shift += 7) {
      const byte = file[at++] as number;
      value |= (byte & 127) << shift;
      if (byte < 128) return value;
    }
  };
  while (at < file.length) {
    const ends = [at];
    const { levels, twoOpacities } = readHeader(file.subarray(at));
    at += HEADER_BYTES;
    for (let level = 0; level < levels; level++) {
      const count = number();
      const size = number(); // before `at` is read: it moves
      at += Number(twoOpacities) + size;
      if (count) ends.push(at);
    }
    ends[ends.length - 1] = at; // empty levels go with the next one, or with the last
    found.push({ palette, increments: ends.slice(1).map((end, i) => file.slice(ends[i], end)) });
  }
  return found;
}

/**
 * Millions of Gaussians a second: of the first round, the best one and the median.
 *
 * @param workers - that decode; 0: this thread does
 */
export async function decodeSpeed(files: readonly Uint8Array[], rounds: number, workers: number) {
  const streams = files.flatMap(streamsOf);
  const decoders = new Decoders((answered, failed) => {
    if (!workers) throw new Error("none are wanted");
    const worker = new StreamWorker();
    worker.onmessage = ({ data }) => answered(data);
    worker.onerror = failed;
    return worker;
  }, workers || 1);
  const times: number[] = [];
  let count = 0;
  for (let round = 0; round < rounds; round++) {
    const begun = performance.now();
    const parts = streams.flatMap(({ palette, increments }, stream) =>
      increments.map((_, i) => decoders.decode(stream, increments.slice(0, i + 1), palette)),
    );
    count = (await Promise.all(parts)).reduce((sum, part) => sum + part.count, 0);
    times.push(performance.now() - begun);
  }
  decoders.close();
  const [first] = times as [number];
  times.sort((a, b) => a - b);
  const speed = (ms: number) => Math.round(count / ms / 10) / 100;
  return { count, first: speed(first), best: speed(times[0] ?? 0), median: speed(times[rounds >> 1] ?? 0) };
}
