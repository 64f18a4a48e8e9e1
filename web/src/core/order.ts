/** The order in which increments are downloaded: by gain per byte. */

import { known } from "./allocate";
import type { File } from "./download";
import { type Candidate, potentialWeight, visibleWeight } from "./planner";
import type { Entry } from "./residency";
import type { Supply } from "./supply";

/** Least weight: out of sight, or without gain. */
const LEAST = 1e-6;

/** Bytes of first levels out of sight that precede all finer levels, so that turning shows no holes. */
const NEARBY = 2 ** 18;

/** Assumed probability that the viewer soon turns to a label out of sight. */
const TURN = 0.25;

/** An increment with its value: pixel-weighted SSIM gain per byte, along the concave hull. */
export interface Step {
  readonly level: number; // 1-based
  readonly value: number;
}

/**
 * The increments from `have` to `wanted` with their values. Since they must come in order, an increment
 * counts with the slope of the concave hull of SSIM over bytes.
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

interface Wanted {
  readonly file: File;
  readonly value: number;
  readonly missing: boolean;
}

/**
 * The missing files of the plan, in order: first levels in sight and of nearby labels, the viewpoint models,
 * then increments by gain per byte. The viewpoint models come last if the plan does not depend on them.
 */
export function inOrder(
  entries: readonly Entry[],
  supply: Supply,
  promises: readonly File[],
  last = false,
): File[] {
  const base: Wanted[] = [];
  const behind: Wanted[] = []; // out of sight
  const rest: Wanted[] = [];
  for (const entry of entries) {
    const { candidate } = entry;
    const files = entry.files(0, entry.wanted);
    const isHere = ({ file, level }: { file: File; level: number }) =>
      entry.decoded[level - 1] !== undefined || entry.decoding === level || supply.isHere(file);
    const have = files.findIndex((one) => !isHere(one));
    const lowest = files[0];
    if (!candidate || !lowest) continue;
    const weight = visibleWeight(candidate);
    let most = Infinity; // keeps the levels of a label in order
    if (!candidate.visible) {
      most = (TURN * potentialWeight(candidate) * (candidate.mean[0] || 1)) / Math.max(lowest.file.bytes, 1);
      behind.push({ file: lowest.file, value: most, missing: have === 0 && !supply.rests(lowest.file) });
    }
    if (have < 0) continue;
    if (entry.steps?.candidate !== candidate || entry.steps.have !== have) {
      entry.steps = { candidate, have, found: steps(candidate, have, entry.wanted, weight) };
    }
    for (const { level, value } of entry.steps.found) {
      const one = files[level - 1];
      if (!one || supply.rests(one.file)) break; // later increments depend on it
      if (isHere(one)) continue;
      if (level > 1) rest.push({ file: one.file, value: Math.min(value, most), missing: true });
      else if (candidate.visible)
        base.push({ file: one.file, value: weight / one.file.bytes, missing: true });
    }
  }
  const models = promises.filter((file) => !supply.rests(file));
  const [nearby, far] = divided(behind);
  const [smallest, more] = [[...best(base), ...best(nearby)], best([...rest, ...far])];
  return last ? [...smallest, ...more, ...models] : [...smallest, ...models, ...more];
}

const best = (list: readonly Wanted[]): File[] =>
  list
    .filter(({ missing }) => missing)
    .sort((a, b) => b.value - a.value)
    .map(({ file }) => file);

/** Splits labels into the best up to `NEARBY` bytes, with those already loaded, and the others. */
function divided(list: readonly Wanted[]): [Wanted[], Wanted[]] {
  const sorted = [...list].sort((a, b) => b.value - a.value);
  let bytes = 0;
  const end = sorted.findIndex(({ file }) => {
    bytes += file.bytes;
    return bytes > NEARBY;
  });
  return end < 0 ? [sorted, []] : [sorted.slice(0, end), sorted.slice(end)];
}
