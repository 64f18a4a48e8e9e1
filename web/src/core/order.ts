/** In which order increments are worth their bytes. */

import { known } from "./allocate";
import type { File } from "./download";
import { type Candidate, worth } from "./planner";
import type { Entry } from "./residency";
import type { Supply } from "./supply";

/** What a label shows less of counts a little less, but is not forgotten. */
const LEAST = 1e-6;

/** An increment and what it is worth: SSIM, weighted by pixels, per byte of the way to where it leads. */
export interface Step {
  readonly level: number; // 1-based
  readonly value: number;
}

/**
 * The increments from `have` to `wanted` with their values. As they must come in order, a step is worth as
 * much as the best way that begins with it: the concave hull of SSIM over bytes.
 *
 * @param weight - of the label in the picture
 */
export function steps(c: Candidate, have: number, wanted: number, weight: number): Step[] {
  const { q, c: bytes } = known([c.mean], [c.ladder.bytes]);
  const quality = q[0] ?? [];
  const cost = bytes[0] ?? [];
  const found: Step[] = [];
  let from = have;
  let last = Infinity;
  while (from < wanted) {
    const start = from > 0 ? (c.ladder.bytes[from - 1] ?? 0) : 0;
    const before = Math.max(0, ...quality.slice(0, from));
    let to = wanted;
    let slope = 0;
    for (let k = from + 1; k <= wanted; k++) {
      const more = (cost[k - 1] ?? Infinity) - start;
      const gained = ((quality[k - 1] ?? 0) - before) / Math.max(more, 1);
      if (gained > slope) [to, slope] = [k, gained];
    }
    const least = LEAST / Math.max((c.ladder.bytes[to - 1] ?? 0) - start, 1);
    last = Math.min(last, Math.max(weight, LEAST) * Math.max(slope, least));
    for (let level = from + 1; level <= to; level++) found.push({ level, value: last });
    from = to;
  }
  return found;
}

/**
 * Files that are missing for the plan: the lowest levels of all labels first, then the promises, then what
 * gains most per byte. The promises come last where nothing depends on them.
 */
export function inOrder(
  entries: readonly Entry[],
  supply: Supply,
  promises: readonly File[],
  last = false,
): File[] {
  const base: { file: File; value: number }[] = [];
  const rest: { file: File; value: number }[] = [];
  for (const entry of entries) {
    const { candidate } = entry;
    const files = entry.files(0, entry.wanted);
    const isHere = ({ file, level }: { file: File; level: number }) =>
      entry.decoded[level - 1] !== undefined || entry.decoding === level || supply.isHere(file);
    const have = files.findIndex((one) => !isHere(one));
    if (!candidate || have < 0) continue;
    const weight = worth(candidate);
    for (const { level, value } of steps(candidate, have, entry.wanted, weight)) {
      const one = files[level - 1];
      if (!one || supply.rests(one.file)) break; // what follows would have to wait for it
      if (isHere(one)) continue;
      if (level === 1) base.push({ file: one.file, value: weight / one.file.bytes });
      else rest.push({ file: one.file, value });
    }
  }
  const best = (list: typeof base) => list.sort((a, b) => b.value - a.value).map(({ file }) => file);
  const models = promises.filter((file) => !supply.rests(file));
  const [smallest, more] = [best(base), best(rest)];
  return last ? [...smallest, ...more, ...models] : [...smallest, ...models, ...more];
}
