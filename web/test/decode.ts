/** How fast coded streams are decoded to what the GPU reads. */

import { StreamDecoder } from "../src/core/stream";
import { Packing } from "../src/view/packing";

/** Millions of Gaussians a second: of the first round, the best one and the median. */
export function decodeSpeed(streams: readonly Uint8Array[], rounds: number): Record<string, number> {
  const times: number[] = [];
  let count = 0;
  for (let round = 0; round < rounds; round++) {
    const begun = performance.now();
    count = 0;
    for (const stream of streams) {
      for (const part of new StreamDecoder(new Packing()).push(stream)) count += part.count;
    }
    times.push(performance.now() - begun);
  }
  const [first] = times as [number];
  times.sort((a, b) => a - b);
  const speed = (ms: number) => Math.round(count / ms / 10) / 100;
  return { count, first: speed(first), best: speed(times[0] ?? 0), median: speed(times[rounds >> 1] ?? 0) };
}
