/** The coded streams of tests/data/streams.json, which the Python package wrote. */

import streams from "../../tests/data/streams.json?raw";
import { Palette } from "../src/core/palette";

export interface Golden {
  readonly name: string;
  readonly content: string; // base64
  readonly palette?: string; // base64
  readonly ends: readonly number[]; // bytes, by level
  readonly sizes: readonly number[]; // Gaussians up to each level
  readonly gaussians: Readonly<
    Record<"means" | "quats" | "log_scales" | "opacities" | "sh0" | "shN", number[]> & { seconds?: number[] }
  >;
  readonly weights?: readonly number[]; // of second opacities, by level
  readonly levels?: readonly (readonly number[])[]; // opacities of all up to a level where it is the newest one
}

export const golden = JSON.parse(streams) as Golden[];

const bytesIn = (text: string) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

export const bytesOf = ({ content }: Golden): Uint8Array => bytesIn(content);

/** The bytes of the palette that a stream needs, if it needs one. */
export const paletteBytesOf = ({ palette }: Golden): Uint8Array | undefined =>
  palette ? bytesIn(palette) : undefined;

export function paletteOf(one: Golden): Palette | null {
  const bytes = paletteBytesOf(one);
  return bytes ? new Palette(bytes) : null;
}

/** A file with the stream alone, and its palette if it needs one. */
export const fileOf = (one: Golden): Uint8Array =>
  Uint8Array.of(...(paletteBytesOf(one) ?? []), ...bytesOf(one));
