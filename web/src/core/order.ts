/** In which order increments are worth their bytes. */

import { known } from "./allocate";
import type { File } from "./download";
import { around, type Candidate, worth } from "./planner";
import type { Entry } from "./residency";
import type { Supply } from "./supply";

/** What a label shows less of counts a little less, but is not forgotten. */
const LEAST = 1e-6;

/** Bytes of lowest levels out of sight that come before anything finer: whoever turns finds no holes. */
const NEARBY = 2 ** 18;

/** How likely it is that one turns to what is out of sight soon. */
const TURN = 0.25;

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

interface Wanted {
  readonly file: File;
  readonly value: number;
  readonly missing: boolean;
}

/**
 * Files that are missing for the plan: the lowest levels in sight first, with those nearby out of sight, then
 * the promises, then what gains most per byte. The promises come last where nothing depends on them.
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
    const weight = worth(candidate);
    let most = Infinity; // so that no level comes before the lowest
    if (!candidate.visible) {
      most = (TURN * around(candidate) * (candidate.mean[0] || 1)) / Math.max(lowest.file.bytes, 1);
      behind.push({ file: lowest.file, value: most, missing: have === 0 && !supply.rests(lowest.file) });
    }
    if (have < 0) continue;
    if (entry.steps?.candidate !== candidate || entry.steps.have !== have) {
      entry.steps = { candidate, have, found: steps(candidate, have, entry.wanted, weight) };
    }
    for (const { level, value } of entry.steps.found) {
      const one = files[level - 1];
      if (!one || supply.rests(one.file)) break; // what follows would have to wait for it
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

/** The best up to `NEARBY` bytes, with those that are here already, and the others. */
function divided(list: readonly Wanted[]): [Wanted[], Wanted[]] {
  const sorted = [...list].sort((a, b) => b.value - a.value);
  let bytes = 0;
  const end = sorted.findIndex(({ file }) => {
    bytes += file.bytes;
    return bytes > NEARBY;
  });
  return end < 0 ? [sorted, []] : [sorted.slice(0, end), sorted.slice(end)];
}
