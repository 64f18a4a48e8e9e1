/** The coded streams of tests/data/streams.json, which the Python package wrote. */

import streams from "../../tests/data/streams.json?raw";

export interface Golden {
  readonly name: string;
  readonly content: string; // base64
  readonly ends: readonly number[]; // bytes, by level
  readonly sizes: readonly number[]; // Gaussians up to each level
  readonly gaussians: Readonly<
    Record<"means" | "quats" | "log_scales" | "opacities" | "sh0" | "shN", number[]> & { seconds?: number[] }
  >;
  readonly weights?: readonly number[]; // of second opacities, by level
  readonly levels?: readonly (readonly number[])[]; // opacities of all up to a level where it is the newest one
}

export const golden = JSON.parse(streams) as Golden[];

export const bytesOf = ({ content }: Golden): Uint8Array =>
  Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0));
