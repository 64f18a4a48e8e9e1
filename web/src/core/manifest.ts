/** Reads and validates manifest.json and promises-*.json. */

import {
  FORMATS,
  type Label,
  type LabelPromises,
  type Manifest,
  type Promises,
  QUALITIES,
  type Quality,
  STATUSES,
} from "../types";
import {
  amount,
  BundleError,
  between,
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
export const VERSION = 4;
const STREAMS_FROM = 4; // version
const PROMISES_VERSION = 2;

const vec3 = list(number, 3);
const optional =
  (check: Check): Check =>
  (value, path, wrong) =>
    value !== undefined && check(value, path, wrong);
const increment: Check = (value, path, wrong) => {
  // a level that adds nothing has no file
  const empty = typeof value === "object" && value !== null && "count" in value && value.count === 0;
  const file = empty ? {} : { uri: relative, sha256: hash };
  object({
    ...file,
    format: oneOf(...FORMATS),
    offset: optional(amount),
    refine: optional(oneOf("REPLACE")),
    bytes: amount,
    gpuBytes: amount,
    count: amount,
    weight: optional(share),
  })(value, path, wrong);
};
const byQuality = (check: Check): Check =>
  object(Object.fromEntries(QUALITIES.map((quality) => [quality, optional(check)])));
const ssim = between(-1, 1);
const quality = object({
  levels: list(level),
  status: oneOf(...STATUSES),
  confidence: share,
  mean: list(ssim),
  bound: orNull(list(between(-3, 1))),
});
const label = object({
  id: whole,
  name: text,
  category: optional(text),
  block: optional(amount),
  title: text,
  color,
  weight: fromZero,
  always: flag,
  hidden: optional(flag),
  parent: optional(text),
  boxes: list(list(number, 6)),
  levels: list(increment),
  quality: byQuality(quality),
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
  ladder: optional(hash),
  labels: list(label),
  promises: byQuality(object({ uri: relative, bytes: amount, sha256: hash })),
  target: object({ quality: oneOf(...QUALITIES), value: ssim }),
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
  const found = checked<Manifest>(upgraded(value), manifest, file);
  refuse([...found.labels.flatMap(oddities), ...oddStreams(found), ...oddPack(found)], file);
  const ids = found.labels.map((l) => l.id);
  refuse(new Set(ids).size < ids.length ? ["labels have the same id twice"] : [], file);
  return found;
}

/** The qualities that some label of a bundle is known by. */
export const qualitiesOf = ({ labels }: Manifest): Quality[] =>
  QUALITIES.filter((quality) => labels.some((one) => one.quality[quality]));

/** A version 1 bundle, of an earlier sagesplat: what it shows can be shown, its promises were other ones. */
function upgraded(value: unknown): unknown {
  const old = value as { version: number; labels?: unknown };
  if (old.version > 1) return value;
  const labels = Array.isArray(old.labels)
    ? old.labels.map((one: unknown) => withoutQuality(one))
    : old.labels;
  return { ...old, labels, promises: {}, target: { quality: "fidelity", value: 0.95 } };
}

const withoutQuality = (one: unknown): unknown =>
  typeof one === "object" && one !== null ? { ...one, quality: {} } : one;

function oddities(one: Label, i: number): string[] {
  const wrong: string[] = [];
  const { levels, boxes } = one;
  if ((one.category === undefined) !== (one.block === undefined)) {
    wrong.push(`labels[${i}] must have both category and block, or neither`);
  }
  if (!levels.length) wrong.push(`labels[${i}].levels is empty`);
  levels.forEach(({ refine, count }, k) => {
    const below = levels.slice(0, k).some((level) => level.count);
    if (refine && !(count && below)) wrong.push(`labels[${i}].levels[${k}] has nothing to replace`);
  });
  if (boxes.some((b) => b[0] > b[3] || b[1] > b[4] || b[2] > b[5])) {
    wrong.push(`labels[${i}].boxes has one whose least is above its most`);
  }
  for (const quality of QUALITIES) {
    const known = one.quality[quality];
    if (!known) continue;
    const path = `labels[${i}].quality.${quality}`;
    if (!isRising(known.levels) || (known.levels.at(-1) ?? 0) > levels.length) {
      wrong.push(`${path}.levels must rise, up to ${levels.length}`);
    }
    for (const values of [known.mean, known.bound ?? known.mean]) {
      if (values.length !== known.levels.length) wrong.push(`${path} must have a number a level`);
    }
  }
  return wrong;
}

/** Streams have one file a label, whose levels are ranges without gaps. */
function oddStreams({ labels, version }: Manifest): string[] {
  const uris = new Set<string>();
  return labels.flatMap((one, i) => {
    const path = `labels[${i}].levels`;
    const files = one.levels.filter(({ count }) => count);
    const streams = files.filter(({ format }) => format === "stream");
    const odd = (what: string) => [`${path} ${what}`];
    if (!streams.length) {
      const is = files.some(({ offset, weight }) => offset !== undefined || weight !== undefined);
      return is ? odd("have offsets or weights, which only streams have") : [];
    }
    const uri = streams[0]?.uri ?? "";
    if (version < STREAMS_FROM) return odd(`have streams, which version ${version} does not have`);
    if (files.some((file) => file.uri !== uri || file.format !== "stream" || file.refine) || uris.has(uri)) {
      return odd("must be one stream of their own");
    }
    uris.add(uri);
    let end = 0;
    const touch = files.every(({ offset, bytes }) => {
      const starts = offset === end && bytes > 0;
      end += bytes;
      return starts;
    });
    if (!touch) return odd("must be ranges of their stream without gaps, from byte 0 on");
    const weights = files.filter(({ weight }) => weight !== undefined).length;
    return weights && weights < files.length ? odd("must all have a weight, or none") : [];
  });
}

function oddPack({ pack, labels }: Manifest): string[] {
  if (!pack) return [];
  const files = pack.order.map(([i, k]) => labels[i]?.levels[k - 1]);
  const bytes = files.reduce((sum, file) => sum + (file?.bytes ?? Number.NaN), 0);
  const once = new Set(pack.order.map((one) => one.join())).size === files.length;
  return bytes === pack.bytes && once ? [] : ["pack.order must name levels that fill pack.bytes, each once"];
}

const unit = between(1e-9, 1);
const curve = object({ params: list(number, 9), range: list(number, 2), median: number });
const model = object({
  id: whole,
  levels: list(level),
  status: oneOf(...STATUSES),
  confidence: share,
  leastSupport: share,
  discount: fromZero,
  targets: list(whole),
  thresholds: list(whole),
  medianLogDistance: number,
  lengths: list(between(1e-6, 1e6), 3),
  curves: list(curve),
  offsets: list(between(-9, 9)),
  views: list(amount),
  logDistances: object({ unit, steps: list(whole) }),
  values: object({ units: list(unit), steps: list(list(whole)) }),
  shares: list(whole),
  corrections: list(whole),
});
const promises = object({
  version: oneOf(PROMISES_VERSION),
  quality: oneOf(...QUALITIES),
  extent: positive,
  views: list(list(whole), 6),
  labels: list(model),
});

/** Parses the viewpoint models of a quality. Throws a BundleError in one line if they are invalid. */
export function parsePromises(json: string, file: string, quality: Quality): Promises {
  const found = checked<Promises>(parse(json, file), promises, file);
  const shared = found.views[0]?.length ?? 0;
  const even = found.views.every((column) => column.length === shared);
  refuse(even ? [] : ["views must have columns of equal length"], file);
  refuse(found.quality === quality ? [] : [`quality must be ${JSON.stringify(quality)}`], file);
  refuse(
    found.labels.flatMap((one, i) => oddModel(one, shared).map((what) => `labels[${i}]${what}`)),
    file,
  );
  return found;
}

function oddModel(one: LabelPromises, shared: number): string[] {
  const [n, K] = [one.views.length, one.levels.length];
  const lists = [one.logDistances.steps, one.corrections, ...one.values.steps];
  const fit =
    n > 0 &&
    K > 0 &&
    lists.every((values) => values.length === n) &&
    [one.offsets, one.values.units, one.values.steps].every((values) => values.length === K) &&
    (one.curves.length === K || !one.curves.length) &&
    one.shares.length === shared &&
    total(one.views) < shared &&
    one.thresholds.length === one.targets.length;
  if (!fit) return [" has lists that do not fit together"];
  const wrong: string[] = [];
  if (n > MOST_VIEWS) wrong.push(` has more than ${MOST_VIEWS} views`);
  if (!isRising(one.levels)) wrong.push(".levels must rise");
  for (const values of [one.targets, one.thresholds]) {
    if (!isRising(values) || values.some((v) => Math.abs(v) > WHOLE)) {
      wrong.push(" must have targets and thresholds that rise from -1 to 1");
    }
  }
  if (!within(one.shares, WHOLE) || !within(one.corrections, 1e5))
    wrong.push(" has shares or corrections out of range");
  const logs = one.logDistances;
  if (!within(logs.steps, 100 / logs.unit) || one.values.steps.some((row) => !within(row, 1e9))) {
    wrong.push(" has values out of range");
  }
  return wrong;
}

const MOST_VIEWS = 2048; // of a model: its weights are solved for
const WHOLE = 10_000; // steps of shares, targets and thresholds in 1

const isRising = (values: readonly number[]): boolean =>
  values.every((value, i) => i === 0 || value > (values[i - 1] ?? 0));

const total = (steps: readonly number[]): number => steps.reduce((sum, step) => sum + step, 0);

/** Whether all running sums are at most so large. */
function within(steps: readonly number[], most: number): boolean {
  let sum = 0;
  return steps.every((step) => {
    sum += step;
    return Math.abs(sum) <= most;
  });
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
