/** Reads and validates manifest.json and promises-*.json by their schema, and by what a schema cannot say. */

import root from "../../../src/sagesplat/viewer/manifest.schema.json";
import {
  type Label,
  type LabelPromises,
  type Manifest,
  type Promises,
  QUALITIES,
  type Quality,
} from "../types";
import type { Fetch } from "./download";
import { BundleError, checked, refuse, type Schema } from "./schema";

/** The version of the format that this viewer reads. */
export const VERSION = 1;

const HEAD: Schema = {
  type: "object",
  required: ["format", "version"],
  properties: { format: { const: "sagesplat-bundle" }, version: { type: "integer" } },
};
const PROMISES: Schema = { $ref: "#/$defs/promises" };

/** Parses a manifest. Throws a BundleError in one line if it is invalid. */
export function parseManifest(json: string, file = "manifest.json"): Manifest {
  const value = parse(json, file);
  const { version } = checked<Manifest>(value, HEAD, file);
  if (version !== VERSION) {
    throw new BundleError(
      `${file}: the bundle has version ${version}, this viewer reads version ${VERSION}. Open it with the index.html that came with it.`,
    );
  }
  const found = checked<Manifest>(value, root, file);
  const ids = new Set(found.labels.map(({ id }) => id));
  const twice = ids.size < found.labels.length ? ["labels have the same id twice"] : [];
  refuse(
    [...twice, ...found.labels.flatMap(labelDefects), ...streamDefects(found), ...packDefects(found)],
    file,
  );
  return found;
}

/** The qualities that some label of a bundle is known by. */
export const qualitiesOf = ({ labels }: Manifest): Quality[] =>
  QUALITIES.filter((quality) => labels.some((one) => one.quality[quality]));

function labelDefects(one: Label, i: number): string[] {
  const wrong: string[] = [];
  const { levels, boxes } = one;
  if (levels[0]?.refine) wrong.push(`labels[${i}].levels[0] has nothing to replace`);
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
function streamDefects({ labels }: Manifest): string[] {
  const uris = new Set<string>();
  return labels.flatMap((one, i) => {
    const path = `labels[${i}].levels`;
    const files = one.levels;
    const streams = files.filter(({ format }) => format === "stream");
    const odd = (what: string) => [`${path} ${what}`];
    if (!streams.length) {
      const is = files.some(({ offset, weight }) => offset !== undefined || weight !== undefined);
      return is ? odd("have offsets or weights, which only streams have") : [];
    }
    const uri = streams[0]?.uri ?? "";
    if (files.some((file) => file.uri !== uri || file.format !== "stream" || file.refine) || uris.has(uri)) {
      return odd("must be one stream of their own");
    }
    uris.add(uri);
    let end = 0;
    const touch = files.every(({ offset, bytes }) => {
      end += bytes;
      return offset === end - bytes;
    });
    if (!touch) return odd("must be ranges of their stream without gaps, from byte 0 on");
    const weights = files.filter(({ weight }) => weight !== undefined).length;
    return weights && weights < files.length ? odd("must all have a weight, or none") : [];
  });
}

function packDefects({ pack, labels }: Manifest): string[] {
  if (!pack) return [];
  const files = pack.order.map(([i, k]) => labels[i]?.levels[k - 1]);
  const bytes = files.reduce((sum, file) => sum + (file?.bytes ?? Number.NaN), 0);
  const once = new Set(pack.order.map((one) => one.join())).size === files.length;
  return bytes === pack.bytes && once ? [] : ["pack.order must name levels that fill pack.bytes, each once"];
}

/** Parses the viewpoint models of a quality. Throws a BundleError in one line if they are invalid. */
export function parsePromises(json: string, file: string, quality: Quality): Promises {
  const found = checked<Promises>(parse(json, file), root, file, PROMISES);
  const shared = found.views[0]?.length ?? 0;
  const even = [found.views, found.photos].every((all) => all.every((one) => one.length === all[0]?.length));
  refuse(even ? [] : ["views and photos must have columns of equal length"], file);
  refuse(found.quality === quality ? [] : [`quality must be ${JSON.stringify(quality)}`], file);
  refuse(
    found.screens[0] <= found.screens[1] ? [] : ["screens must be from the smaller to the larger"],
    file,
  );
  refuse(
    found.labels.flatMap((one, i) => modelDefects(one, shared).map((what) => `labels[${i}]${what}`)),
    file,
  );
  return found;
}

function modelDefects(one: LabelPromises, shared: number): string[] {
  const [n, K] = [one.views.length, one.levels.length];
  const lists = [one.logDistances.steps, one.corrections, ...one.values.steps];
  const fit =
    lists.every((values) => values.length === n) &&
    [one.offsets, one.values.units, one.values.steps].every((values) => values.length === K) &&
    (one.curves.length === K || !one.curves.length) &&
    one.shares.length === shared &&
    total(one.views) < shared &&
    [one.thresholds, one.slopes].every((values) => values.length === one.targets.length);
  if (!fit) return [" has lists that do not fit together"];
  const wrong: string[] = [];
  if (!isRising(one.levels)) wrong.push(".levels must rise");
  if (!isRising(one.targets) || !below(one.targets, WHOLE)) {
    wrong.push(".targets must rise, from -1 to 1");
  }
  if (!below(one.thresholds, MOST) || !below(one.slopes, MOST))
    wrong.push(" has thresholds or slopes out of range");
  if (!within(one.shares, WHOLE) || !within(one.corrections, 1e5))
    wrong.push(" has shares or corrections out of range");
  const logs = one.logDistances;
  if (!within(logs.steps, 100 / logs.unit) || one.values.steps.some((row) => !within(row, MOST))) {
    wrong.push(" has values out of range");
  }
  return wrong;
}

const WHOLE = 10_000; // steps of shares and targets in 1
const MOST = 1e9; // steps of anything

const below = (values: readonly number[], most: number): boolean =>
  values.every((value) => Math.abs(value) <= most);

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
