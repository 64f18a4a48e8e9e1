import { type Job, Streams } from "./decoding";

const streams = new Streams();

self.onmessage = ({ data }: MessageEvent<readonly Job[]>) => {
  const answers = data.map((job) => streams.answer(job));
  const buffers = answers.flatMap(({ part }) =>
    part ? [part.splats, ...part.harmonics.values(), part.opacities ?? new Uint8Array(0)] : [],
  );
  self.postMessage(answers, { transfer: buffers.map(({ buffer }) => buffer) });
};
