/** The opacity of splats that have two: one for the low levels of a category, one for the full model. */

import type { Part } from "./packing";

/** Opacities in 1/255 by those of a splat: the logit is linear in the weight of the second one. */
class Blend {
  private readonly known = new Int16Array(1 << 16).fill(-1);
  constructor(private readonly weight: number) {}

  at(first: number, second: number): number {
    const place = (first << 8) | second;
    const known = this.known[place] as number;
    if (known >= 0) return known;
    const [a, b] = [logit(first), logit(second)];
    const opacity = Math.round(255 / (1 + Math.exp(-(a + (b - a) * this.weight))));
    this.known[place] = opacity;
    return opacity;
  }
}

/** 0 and 255 count as a quarter of a step further inside, as in formats/quantisation.py. */
function logit(byte: number): number {
  const opacity = Math.max(0.25, Math.min(byte, 254.75)) / 255;
  return Math.log(opacity / (1 - opacity));
}

/** Enters the second opacities that have come with a later part. */
export function enterEarlier(parts: readonly Part[]): void {
  parts.forEach(({ earlier }, i) => {
    let end = earlier?.length ?? 0;
    for (let k = i - 1; k >= 0 && end > 0; k--) {
      const { count, opacities } = parts[k] as Part;
      const start = end - count;
      for (let row = Math.max(0, -start); opacities && row < count; row++) {
        opacities[2 * row + 1] = earlier?.[start + row] as number;
      }
      end = start;
    }
  });
}

/** Sets the opacities in a part's words, for a weight of the second ones. */
export function blendOpacities(words: Uint32Array, { count, opacities }: Part, weight: number): void {
  if (!opacities) return;
  const blend = new Blend(weight);
  for (let i = 0, at = 0; i < count; i++, at += 4) {
    const opacity = blend.at(opacities[2 * i] as number, opacities[2 * i + 1] as number);
    words[at] = ((words[at] as number) & 0xffffff) | (opacity << 24);
  }
}
