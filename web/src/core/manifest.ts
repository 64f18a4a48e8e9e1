/** Reads and validates manifest.json and promises-*.json. */

import type { Label, Manifest, Promises } from "../types";
import {
  amount,
  BundleError,
  type Check,
  checked,
  color,
  flag,
  fromZero,
  hash,
  level,
  list,
  number,
  object,
  oneOf,
  orNull,
  positive,
  refuse,
  relative,
  share,
  text,
  whole,
} from "./check";
import type { Fetch } from "./download";

/** The newest version of the format that this viewer supports. */
export const VERSION = 1;

const vec3 = list(number, 3);
const increment: Check = (value, path, wrong) => {
  // a level that adds nothing has no file
  const empty = typeof value === "object" && value !== null && "count" in value && value.count === 0;
  const file = empty ? {} : { uri: relative, sha256: hash };
  object({ ...file, format: oneOf("spz"), bytes: amount, gpuBytes: amount, count: amount })(
    value,
    path,
    wrong,
  );
};
const quality = object({
  status: oneOf("calibrated", "pooled", "uncalibrated"),
  confidence: share,
  margin: list(number),
  curves: list(
    object({ level, params: list(number, 9), range: list(number, 2), median: number, rmse: fromZero }),
  ),
});
const optional =
  (check: Check): Check =>
  (value, path, wrong) =>
    value !== undefined && check(value, path, wrong);
const label = object({
  id: whole,
  name: text,
  category: optional(text),
  block: optional(amount),
  title: text,
  color,
  weight: fromZero,
  always: flag,
  boxes: list(list(number, 6)),
  levels: list(increment),
  quality: orNull(quality),
});
const camera = object({
  name: text,
  split: oneOf("train", "test", "calibration"),
  position: vec3,
  quaternion: list(number, 4),
  fovY: positive,
  width: positive,
  height: positive,
  intrinsics: list(number, 4),
});
const pack = object({ uri: relative, bytes: amount, sha256: hash, order: list(list(amount, 2)) });
const manifest = object({
  generator: text,
  name: text,
  live: flag,
  frame: object({
    axes: oneOf("rub"),
    up: vec3,
    floor: number,
    extent: fromZero,
    metersPerUnit: positive,
    scale: oneOf("given", "guessed"),
  }),
  shDegree: oneOf(0, 1, 2, 3),
  antialiased: flag,
  background: list(share, 3),
  totals: object({ count: amount, bytes: amount, gpuBytes: amount }),
  labels: list(label),
  promises: orNull(object({ uri: relative, bytes: amount, sha256: hash })),
  pack: optional(orNull(pack)), // older bundles have none
  cameras: list(camera),
  start: object({ position: vec3, quaternion: list(number, 4), target: vec3 }),
  licenses: list(object({ what: text, license: text })),
});

/** Parses a manifest. Throws a BundleError in one line if it is invalid. */
export function parseManifest(json: string, file = "manifest.json"): Manifest {
  const value = parse(json, file);
  const head = checked<Manifest>(value, object({ format: oneOf("sagesplat-bundle"), version: level }), file);
  if (head.version > VERSION) {
    throw new BundleError(
      `${file}: the bundle has version ${head.version}, this viewer reads up to ${VERSION}. Open it with the index.html that came with it.`,
    );
  }
  const found = checked<Manifest>(value, manifest, file);
  refuse([...found.labels.flatMap(oddities), ...oddPack(found)], file);
  const ids = found.labels.map((l) => l.id);
  refuse(new Set(ids).size < ids.length ? ["labels have the same id twice"] : [], file);
  return found;
}

function oddities(one: Label, i: number): string[] {
  const wrong: string[] = [];
  const { levels, quality: q, boxes } = one;
  if ((one.category === undefined) !== (one.block === undefined)) {
    wrong.push(`labels[${i}] must have both category and block, or neither`);
  }
  if (!levels.length) wrong.push(`labels[${i}].levels is empty`);
  if (boxes.some((b) => b[0] > b[3] || b[1] > b[4] || b[2] > b[5])) {
    wrong.push(`labels[${i}].boxes has one whose least is above its most`);
  }
  if (!q) return wrong;
  if (q.margin.length !== q.curves.length)
    wrong.push(`labels[${i}].quality.margin must have a number a curve`);
  const known = q.curves.map((c) => c.level);
  if (known.some((k, j) => k > levels.length || (j > 0 && k <= (known[j - 1] ?? 0)))) {
    wrong.push(`labels[${i}].quality.curves must be of rising levels up to ${levels.length}`);
  }
  return wrong;
}

function oddPack({ pack, labels }: Manifest): string[] {
  if (!pack) return [];
  const files = pack.order.map(([i, k]) => labels[i]?.levels[k - 1]);
  const bytes = files.reduce((sum, file) => sum + (file?.bytes ?? Number.NaN), 0);
  const once = new Set(pack.order.map((one) => one.join())).size === files.length;
  return bytes === pack.bytes && once ? [] : ["pack.order must name levels that fill pack.bytes, each once"];
}

const view = list(number, 6);
const model = object({
  id: whole,
  levels: list(level),
  usual: number,
  lengths: list(positive, 3),
  unseen: fromZero,
  noise: positive,
  factor: fromZero,
  confidence: share,
  shift: number,
  mixing: fromZero,
  amplitudes: list(number),
  views: list(amount),
  unseenViews: list(oneOf(0, 1)),
  logDistances: list(number),
  corrections: list(number),
  weights: list(list(number)),
  shares: list(share),
});
const promises = object({ version: level, extent: positive, views: list(view), labels: list(model) });

/** Parses the viewpoint models. Throws a BundleError in one line if they are invalid. */
export function parsePromises(json: string, file: string): Promises {
  const found = checked<Promises>(parse(json, file), promises, file);
  const wrong = found.labels.flatMap((one, i) => {
    const [n, K] = [one.views.length, one.levels.length];
    const lengths = [
      one.unseenViews.length,
      one.logDistances.length,
      one.corrections.length,
      one.weights.length,
    ];
    const fits =
      n > 0 &&
      K > 0 &&
      lengths.every((length) => length === n) &&
      one.amplitudes.length === K &&
      one.weights.every((row) => row.length === K) &&
      one.shares.length === found.views.length &&
      one.views.every((row) => row < found.views.length);
    return fits ? [] : [`labels[${i}] has lists that do not fit together`];
  });
  refuse(wrong, file);
  return found;
}

function parse(json: string, file: string): unknown {
  try {
    return JSON.parse(json);
  } catch {
    throw new BundleError(`${file}: not JSON. Make the bundle again with sagesplat bundle.`);
  }
}

/**
 * The manifest of the bundle in a folder.
 *
 * @param base - URL of the folder, ending in a slash
 * @returns a checked manifest; rejects with a BundleError in one line
 */
export async function loadManifest(base: URL, fetch: Fetch): Promise<Manifest> {
  const url = new URL("manifest.json", base).href;
  const lost = (why: string) =>
    new BundleError(`${url}: ${why}. Check the address and serve the folder with sagesplat view.`);
  let json: string;
  try {
    const reply = await fetch(url);
    if (!reply.ok)
      throw lost(reply.status === 404 ? "there is no bundle here" : `the server said ${reply.status}`);
    json = await reply.text();
  } catch (error) {
    throw error instanceof BundleError ? error : lost("cannot be reached");
  }
  return parseManifest(json);
}
