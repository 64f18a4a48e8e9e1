import { type Job, Streams } from "./decoding";

const streams = new Streams();

self.onmessage = ({ data }: MessageEvent<Job>) => {
  const answer = streams.answer(data);
  const { part } = answer;
  const buffers = part && [part.splats, ...part.harmonics.values(), part.opacities ?? new Uint8Array(0)];
  self.postMessage(answer, { transfer: (buffers ?? []).map(({ buffer }) => buffer) });
};
