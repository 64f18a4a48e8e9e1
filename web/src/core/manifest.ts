/** Reads and validates manifest.json and promises-*.json by their schema, and by what a schema cannot say. */

import root from "../../../src/sagesplat/viewer/manifest.schema.json";
import type * as documents from "../documents";
import {
  type Cell,
  type CellPromises,
  type Label,
  type LabelPromises,
  type Level,
  type Manifest,
  type Promises,
  QUALITIES,
  type Quality,
} from "../types";
import type { Fetch, File } from "./download";
import { unpacked } from "./numbers";
import { filesOf } from "./pack";
import { levelsOf } from "./quality";
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
  const document = checked<documents.Manifest>(value, root, file);
  refuse(document.labels.flatMap(levelsDefects), file);
  const found = expanded(document);
  refuse(
    [
      ...(repeats(found.labels) ? ["labels have the same id twice"] : []),
      ...(repeats(found.labels.flatMap(({ cells }) => cells)) ? ["cells have the same id twice"] : []),
      ...found.labels.flatMap(labelDefects),
      ...streamDefects(found),
      ...packDefects(found),
    ],
    file,
  );
  return found;
}

/** The manifest with the levels of cells one by one, and a key for each file and range. */
function expanded(document: documents.Manifest): Manifest {
  const { fidelity, ssim } = document.promises;
  const keyed = <T extends { sha256: string }>(file: T) => ({ ...file, key: file.sha256 });
  const labels = document.labels.map(({ palette, ...label }) => ({
    ...label,
    ...(palette && { palette: keyed(palette) }),
    cells: label.cells.map((cell) => ({
      ...cell,
      levels: cell.levels.flatMap((some) => levelsIn(some, document.gpuBytes)),
    })),
  }));
  return {
    ...document,
    labels,
    promises: { ...(fidelity && { fidelity: keyed(fidelity) }), ...(ssim && { ssim: keyed(ssim) }) },
    totals: { ...document.totals, gpuBytes: document.gpuBytes * document.totals.count },
  };
}

/** The levels of a file or stream. */
function levelsIn(some: documents.Levels, gpuBytes: number): Level[] {
  const { uri, format, offset, sha256, refine, weights, counts } = some;
  const digits = sha256.length / counts.length;
  let end = offset ?? 0;
  return some.bytes.map((bytes, i) => {
    const [count, weight, begin] = [counts[i] as number, weights?.[i], end];
    end += bytes;
    return {
      uri,
      format,
      ...(offset !== undefined && { offset: begin }),
      bytes,
      gpuBytes: gpuBytes * count,
      count,
      key: offset === undefined ? uri : `${uri}:${begin}`,
      sha256: sha256.slice(digits * i, digits * (i + 1)),
      ...(refine && i === 0 && { refine }),
      ...(weight !== undefined && { weight }),
    };
  });
}

/** What is wrong with lists of levels, before they are read. */
function levelsDefects({ cells }: documents.Label, i: number): string[] {
  return cells.flatMap(({ levels }, j) =>
    levels.flatMap(({ format, offset, sha256, weights, bytes, counts }, k) => {
      const path = `labels[${i}].cells[${j}].levels[${k}]`;
      const isStream = format === "stream";
      const even = [counts, weights ?? bytes].every((list) => list.length === bytes.length);
      return [
        ...(even ? [] : [`${path} must have a number a level`]),
        ...(sha256.length % bytes.length ? [`${path}.sha256 must have as many digits for each level`] : []),
        ...(isStream === (offset !== undefined)
          ? []
          : [`${path} must have an offset exactly if it is a stream`]),
        ...(isStream || (bytes.length === 1 && !weights)
          ? []
          : [`${path} must be one level without a weight, as it is a file`]),
      ];
    }),
  );
}

const repeats = (all: readonly { readonly id: number }[]): boolean =>
  new Set(all.map(({ id }) => id)).size < all.length;

/** The qualities that some label of a bundle is known by. */
export const qualitiesOf = ({ labels }: Manifest): Quality[] =>
  QUALITIES.filter((quality) => labels.some((one) => one.quality[quality]));

function labelDefects(one: Label, i: number): string[] {
  const wrong = one.cells.flatMap((cell, j) => cellDefects(cell, `labels[${i}].cells[${j}]`));
  const most = levelsOf(one);
  for (const quality of QUALITIES) {
    const known = one.quality[quality];
    if (!known) continue;
    const path = `labels[${i}].quality.${quality}`;
    if (!isRising(known.levels) || (known.levels.at(-1) ?? 0) > most) {
      wrong.push(`${path}.levels must rise, up to ${most}`);
    }
    for (const values of [known.mean, known.bound ?? known.mean]) {
      if (values.length !== known.levels.length) wrong.push(`${path} must have a number a level`);
    }
  }
  return wrong;
}

function cellDefects({ levels, bounds, points }: Cell, path: string): string[] {
  const wrong: string[] = [];
  if (levels[0]?.refine) wrong.push(`${path}.levels[0] has nothing to replace`);
  if (bounds[0] > bounds[3] || bounds[1] > bounds[4] || bounds[2] > bounds[5]) {
    wrong.push(`${path}.bounds has a least above its most`);
  }
  if (atob(points).length % 4) wrong.push(`${path}.points must have four bytes a point`);
  return wrong;
}

const ALONE = "must be one stream, in a file of the label's own";

/** Of a cell, the levels that are ranges touch from one that replaces to the next; all of a label fill a file. */
function streamDefects({ labels }: Manifest): string[] {
  const others = new Set<string>(); // files of the labels before
  return labels.flatMap(({ cells, palette }, i) => {
    const wrong: string[] = [];
    const ranges: File[] = palette ? [palette] : [];
    for (const [j, { levels }] of cells.entries()) {
      const odd = (what: string) => wrong.push(`labels[${i}].cells[${j}].levels ${what}`);
      const streams = levels.filter(({ format }) => format === "stream");
      const uri = (ranges[0] ?? streams[0])?.uri ?? "";
      ranges.push(...streams);
      if (streams.some((level) => level.uri !== uri) || others.has(uri)) {
        odd(ALONE);
      }
      levels.forEach((level, k) => {
        const below = levels[k - 1];
        if (!below || level.refine) return;
        if (level.format !== below.format && [level, below].some(({ format }) => format === "stream")) {
          odd(ALONE);
        }
      });
      const touch = levels.every(({ format, refine, offset }, k) => {
        const below = refine ? undefined : levels[k - 1];
        return format !== "stream" || offset === (below ? (below.offset ?? 0) + below.bytes : offset);
      });
      if (!touch) odd("must be ranges without gaps");
      const weights = levels.filter(({ weight }) => weight !== undefined).length;
      if (weights && weights < levels.length) odd("must all have a weight, or none");
      if (weights && levels.some(({ refine }) => refine)) odd("have weights, and some replace those below");
    }
    const ends = new Map<string, number>();
    for (const { uri, offset, bytes } of ranges.sort((a, b) => (a.offset ?? 0) - (b.offset ?? 0))) {
      if (offset !== (ends.get(uri) ?? 0) && !wrong.length) {
        wrong.push(`labels[${i}].cells must have ranges that fill their file, from byte 0 on`);
      }
      ends.set(uri, (offset ?? 0) + bytes);
    }
    for (const uri of ends.keys()) others.add(uri);
    return wrong;
  });
}

function packDefects(manifest: Manifest): string[] {
  const { pack } = manifest;
  if (!pack) return [];
  const files = filesOf(manifest);
  const bytes = files.reduce((sum, file) => sum + file.bytes, 0);
  const once = new Set(pack.order.map((one) => one.join())).size === pack.order.length;
  const good = bytes === pack.bytes && once && files.length === pack.order.length;
  return good ? [] : ["pack.order must name levels that fill pack.bytes, each once"];
}

/** Parses the viewpoint models of a quality. Throws a BundleError in one line if they are invalid. */
export function parsePromises(json: string, file: string, quality: Quality): Promises {
  const found = checked<Promises>(unpacked(parse(json, file), file), root, file, PROMISES);
  const shared = found.views[0]?.length ?? 0;
  const even = [found.views, found.photos].every((all) => all.every((one) => one.length === all[0]?.length));
  refuse(even ? [] : ["views and photos must have columns of equal length"], file);
  const whole = found.labels.every(({ cells }) => cells.every(({ id }) => id < 0 === (quality === "ssim")));
  refuse(whole ? [] : ["labels have models of cells for fidelity, of the whole label for ssim"], file);
  refuse(found.levels || quality === "ssim" ? [] : ["levels must say how many the ladder has"], file);
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
  const wrong = one.cells.flatMap((own, j) =>
    cellModelDefects(own, shared).map((what) => `.cells[${j}]${what}`),
  );
  if (repeats(one.cells)) wrong.push(".cells have the same id twice");
  if ([one.thresholds, one.slopes].some((values) => values.length !== one.targets.length)) {
    wrong.push(" has lists that do not fit together");
  }
  if (!isRising(one.targets) || !below(one.targets, WHOLE)) {
    wrong.push(".targets must rise, from -1 to 1");
  }
  if (!below(one.thresholds, MOST) || !below(one.slopes, MOST))
    wrong.push(" has thresholds or slopes out of range");
  return wrong;
}

function cellModelDefects(one: CellPromises, shared: number): string[] {
  const [n, K] = [one.rows.length, one.offsets.length];
  const { factors = [], corrections = [], curves = [], shares = [] } = one;
  const { levels, units, values, ladder, terms, logDistances, logUnit } = one;
  const has = (list: readonly number[], length: number) => list.length === length || !list.length;
  const fit =
    [logDistances, ...(terms ?? values ?? [])].every((row) => row.length === n) &&
    (one.id < 0
      ? [levels, units, values].every((list) => list?.length === K)
      : ladder?.length === K && terms !== undefined) &&
    (curves.length === K || !curves.length) &&
    has(factors, shared) &&
    has(shares, shared) &&
    has(corrections, n) &&
    one.rows.every((row) => row < shared);
  if (!fit) return [" has lists that do not fit together"];
  const wrong: string[] = [];
  if (!isRising(levels ?? ladder ?? [])) wrong.push(".levels must rise");
  if (!below(factors, 1e6) || !below(corrections, 1e5) || !below(shares, WHOLE))
    wrong.push(" has factors, shares or corrections out of range");
  const inRange = (values ?? terms ?? []).every((row) => below(row, MOST));
  if (!inRange || !below(logDistances, 100 / logUnit) || !below(one.offsets, 9 * WHOLE))
    wrong.push(" has values out of range");
  return wrong;
}

const WHOLE = 10_000; // steps of shares and targets in 1
const MOST = 1e9; // steps of anything

const below = (values: readonly number[], most: number): boolean =>
  values.every((value) => Math.abs(value) <= most);

const isRising = (values: readonly number[]): boolean =>
  values.every((value, i) => i === 0 || value > (values[i - 1] ?? 0));

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
