/** The order in which increments are downloaded: by gain per byte. */

import { known } from "./allocate";
import type { File } from "./download";
import type { Downloads } from "./downloads";
import { type Candidate, potentialWeight, visibleWeight } from "./planner";
import type { Entry, Step } from "./residency";

/** Least weight: out of sight, or without gain. */
const LEAST = 1e-6;

/** Bytes of first levels out of sight that precede all finer levels, so that turning shows no holes. */
const NEARBY = 2 ** 18;

/** Assumed probability that the viewer soon turns to a cell out of sight. */
const TURN = 0.25;

/**
 * The increments of a path from `have` on with their values. Since they must come in order, an increment
 * counts with the slope of the concave hull of SSIM over bytes.
 *
 * @param files - increments by level of the cell
 * @param path - levels of the increments on the way to the planned level
 * @param have - how many of them are there
 * @param weight - of the cell in the picture
 * @param shown - level whose quality there is already
 */
export function steps(
  c: Pick<Candidate, "mean" | "ladder">,
  files: readonly File[],
  path: readonly number[],
  have: number,
  weight: number,
  shown = 0,
): Step[] {
  const { q, c: bytes } = known([c.mean], [c.ladder.bytes]);
  const quality = path.map((level) => q[0]?.[level - 1] ?? 0);
  const sums = sumsOf(files, path);
  const found: Step[] = [];
  let from = have;
  let last = Infinity;
  while (from < path.length) {
    const start = sums[from] ?? 0;
    const before = Math.max(0, q[0]?.[shown - 1] ?? 0, ...quality.slice(0, from));
    let to = path.length;
    let slope = 0;
    for (let k = from + 1; k <= path.length; k++) {
      const isKnown = (bytes[0]?.[(path[k - 1] ?? 0) - 1] ?? Infinity) < Infinity;
      const more = isKnown ? (sums[k] ?? 0) - start : Infinity;
      const gained = ((quality[k - 1] ?? 0) - before) / Math.max(more, 1);
      if (gained > slope) [to, slope] = [k, gained];
    }
    const least = LEAST / Math.max((sums[to] ?? 0) - start, 1);
    last = Math.min(last, Math.max(weight, LEAST) * Math.max(slope, least));
    for (const level of path.slice(from, to)) found.push({ level, value: last });
    from = to;
  }
  return found;
}

/** Bytes of the first 0, 1, ... increments of a path. */
function sumsOf(files: readonly File[], path: readonly number[]): number[] {
  let sum = 0;
  return [0, ...path.map((level) => (sum += files[level - 1]?.bytes ?? 0))];
}

interface Wanted {
  readonly file: File;
  readonly value: number;
  readonly missing: boolean;
}

/**
 * The missing files of the plan, in order: first levels in sight and of cells nearby, the viewpoint models,
 * then increments by gain per byte.
 *
 * @param models - the viewpoint models come last if the plan does not depend on them; nothing comes after them
 *   while it does: what is fetched for a plan that they change would be fetched in vain
 */
export function inOrder(
  entries: readonly Entry[],
  downloads: Downloads,
  promises: readonly File[],
  models: "first" | "last" | "awaited" = "first",
): File[] {
  const base: Wanted[] = [];
  const behind: Wanted[] = []; // out of sight
  const rest: Wanted[] = [];
  for (const entry of entries) {
    const { candidate } = entry;
    const files = entry.path;
    const first = files[0]?.level ?? 0;
    const isHere = ({ file, level }: { file: File; level: number }) =>
      entry.has(level) || entry.decoding === level || downloads.isHere(file);
    const have = files.findIndex((one) => !isHere(one));
    const lowest = entry.cell.levels[0];
    if (!candidate || !lowest || !first) continue;
    const weight = visibleWeight(candidate);
    let most = Infinity; // keeps the levels of a cell in order
    if (!candidate.visible) {
      most = (TURN * potentialWeight(candidate) * (candidate.mean[0] || 1)) / Math.max(lowest.bytes, 1);
      const missing = first === 1 && have === 0 && !downloads.isBackingOff(lowest);
      behind.push({ file: lowest, value: most, missing });
    }
    if (have < 0) continue;
    const { steps: told } = entry;
    if (told?.candidate !== candidate || told.have !== have || told.first !== first) {
      const path = files.map(({ level }) => level);
      const found = steps(candidate, entry.cell.levels, path, have, weight, first > 1 ? entry.shown : 0);
      entry.steps = { candidate, have, first, found };
    }
    let at = have;
    for (const { level, value } of entry.steps?.found ?? []) {
      const one = files[at];
      at += 1;
      if (!one || downloads.isBackingOff(one.file)) break; // later increments depend on it
      if (isHere(one)) continue;
      if (level > 1) rest.push({ file: one.file, value: Math.min(value, most), missing: true });
      else if (candidate.visible)
        base.push({ file: one.file, value: weight / one.file.bytes, missing: true });
    }
  }
  const missing = promises.filter((file) => !downloads.isBackingOff(file));
  const [nearby, far] = divided(behind);
  const [smallest, more] = [[...best(base), ...best(nearby)], best([...rest, ...far])];
  if (models === "awaited") return [...smallest, ...missing];
  return models === "last" ? [...smallest, ...more, ...missing] : [...smallest, ...missing, ...more];
}

const best = (list: readonly Wanted[]): File[] =>
  list
    .filter(({ missing }) => missing)
    .sort((a, b) => b.value - a.value)
    .map(({ file }) => file);

/** Splits cells into the best up to `NEARBY` bytes, with those already loaded, and the others. */
function divided(list: readonly Wanted[]): [Wanted[], Wanted[]] {
  const sorted = [...list].sort((a, b) => b.value - a.value);
  let bytes = 0;
  const end = sorted.findIndex(({ file }) => {
    bytes += file.bytes;
    return bytes > NEARBY;
  });
  return end < 0 ? [sorted, []] : [sorted.slice(0, end), sorted.slice(end)];
}
