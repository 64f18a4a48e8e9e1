/** How a bundle arrives over slow links: the streamer against one file and against files in their order. */

import { gzipSync } from "node:zlib";
import { inAdvance } from "../src/core/advance";
import { rotate } from "../src/core/distance";
import type { Fetch } from "../src/core/download";
import { loadManifest, parseManifest, parsePromises } from "../src/core/manifest";
import { Pack } from "../src/core/pack";
import { ladderOf } from "../src/core/planner";
import { entriesOf } from "../src/core/residency";
import { Streamer } from "../src/core/streamer";
import { familiesOf, ViewpointModels } from "../src/core/viewpoints";
import type { Manifest, Settings, Viewpoint } from "../src/types";
import { FakeRenderer, Network, putIncrements, VirtualClock } from "./simulate";
import { BASE, frustumOf, lensOf, NO_BUDGET } from "./worlds";

/** The texts of a bundle; of its chunks only the sizes matter. */
export interface Documents {
  readonly manifest: string;
  readonly promises: string; // of fidelity
}

/** A link with a round trip of 100 ms; without HTTP/2 a browser opens 6 connections. */
export interface Line {
  readonly mbit: number;
  readonly connections: number;
}

const LATENCY = 100; // ms
const DECODES = 1; // ms, of an increment, assumed: some hundred splats of 1 to 2 million a second, and two messages

/** One point of a curve: ms since the start, bytes received, expected SSIM of the picture weighted by pixels. */
export interface Sample {
  readonly ms: number;
  readonly bytes: number;
  readonly ssim: number;
  readonly whole: boolean; // everything is there, at its smallest level at least
  readonly takes: number; // bytes of what is planned, with the manifest
}

const NOTHING: Sample = { ms: 0, bytes: 0, ssim: 0, whole: false, takes: 0 };
const FULL: Settings = {
  mode: "full",
  quality: "fidelity",
  target: 0.95,
  budget: NO_BUDGET,
  weights: new Map(),
  cacheBytes: 1e9,
  aroundBytes: 0,
};

const cellsOf = ({ labels }: Manifest) => labels.flatMap(({ cells }) => cells);

/** A link with a bundle at its other end. */
function linkTo(documents: Documents, { mbit, connections }: Line) {
  const clock = new VirtualClock();
  const network = new Network(clock, (mbit * 1e6) / 8, LATENCY, connections);
  const manifest = parseManifest(documents.manifest);
  const put = (uri: string, text: string) => {
    network.files.set(uri, new TextEncoder().encode(text));
    network.packed.set(uri, gzipSync(text).length);
  };
  put("manifest.json", documents.manifest);
  const { fidelity } = manifest.promises;
  if (fidelity) put(fidelity.uri, documents.promises);
  putIncrements(network, manifest);
  const renderer = new FakeRenderer(clock, DECODES);
  const replacing = cellsOf(manifest).flatMap(({ levels }) =>
    levels.flatMap((l, k) => (l.refine ? [k + 1] : [])),
  );
  renderer.begins = [...new Set([1, ...replacing])];
  return { clock, network, renderer };
}

/** Says the expected SSIM of some levels of cells (0: nothing) at a viewpoint: 0 where nothing is drawn. */
export function judge(manifest: Manifest, promises: string): (view: Viewpoint, levels: number[]) => number {
  const models = new ViewpointModels(
    "fidelity",
    manifest.labels,
    parsePromises(promises, "promises", "fidelity"),
  );
  const entries = entriesOf(manifest.labels);
  const families = familiesOf(entries);
  return (view, levels) => {
    let [sum, total] = [0, 0];
    models.see(families, view);
    entries.forEach((entry, i) => {
      const known = entry.mean.some((value) => !Number.isNaN(value));
      if (!entry.sight.visible || !known) return;
      const values = entry.mean.slice(0, levels[i] ?? 0).filter((value) => !Number.isNaN(value));
      sum += entry.share * Math.max(0, ...values);
      total += entry.share;
    });
    return total > 0 ? sum / total : 0;
  };
}

/** The viewpoints of the capture's cameras, in their order. */
export const cameraViews = (manifest: Manifest): Viewpoint[] =>
  manifest.cameras.map(({ position, quaternion, fovY, width, height }) => ({
    position,
    direction: rotate(quaternion, [0, 0, -1]),
    frustum: frustumOf(position, quaternion, fovY, width / height),
    lens: lensOf(fovY, width / height),
  }));

function startView(manifest: Manifest): Viewpoint {
  const { position, quaternion } = manifest.start;
  const direction = rotate(quaternion, [0, 0, -1]);
  return { position, direction, frustum: frustumOf(position, quaternion, 0.9, 1.6), lens: lensOf(0.9, 1.6) };
}

/** The page names the pack and the promises, which a browser asks for together with the manifest. */
function namedInAdvance({ manifest }: Documents, { fetch }: Network): Fetch {
  const found = parseManifest(manifest);
  const { beginning } = new Pack(found);
  const bytes = beginning.reduce((sum, file) => sum + file.bytes, 0);
  const url = (uri = "") => new URL(uri, BASE).href;
  const pack = bytes ? inAdvance(fetch, url(beginning[0]?.uri), bytes).fetch : fetch;
  const { fidelity } = found.promises;
  const early = fidelity && fetch(url(fidelity.uri));
  return (asked, init) => (early && asked === url(fidelity.uri) ? early : pack(asked, init));
}

/** SSIM over time of the streamer, which fetches everything in the end or what a target asks for. */
export async function streamed(
  documents: Documents,
  line: Line,
  partial: Partial<Settings>,
): Promise<Sample[]> {
  const { clock, network, renderer } = linkTo(documents, line);
  const fetch = namedInAdvance(documents, network);
  const head = documents.manifest.length;
  const curve: Sample[] = [NOTHING];
  const streamers = loadManifest(BASE, fetch).then((manifest) => {
    const ssim = judge(manifest, documents.promises);
    const view = startView(manifest);
    const settings = { ...FULL, ...partial };
    const streamer = new Streamer({ manifest, base: BASE, renderer, settings, clock, fetch, digest: null });
    renderer.watch = () => {
      const { labels, bytesLoaded, status } = streamer.state;
      const cells = labels.flatMap((label) => label.cells);
      const levels = cells.map((cell) => cell.shown);
      const whole = status !== "loading";
      const planned = cells.map(({ cell, wanted }) => ladderOf(cell).bytes[wanted - 1] ?? 0);
      const takes = planned.reduce((sum, bytes) => sum + bytes, head + documents.promises.length);
      curve.push({ ms: clock.now(), bytes: head + bytesLoaded, ssim: ssim(view, levels), whole, takes });
    };
    streamer.update(view);
    streamer.start();
    return streamer;
  });
  await clock.pass(60_000);
  renderer.watch = () => {};
  (await streamers).dispose();
  return curve;
}

/** SSIM over time if all comes as one file. */
export function oneFile(documents: Documents, { mbit }: Line): Sample[] {
  const manifest = parseManifest(documents.manifest);
  const ms = LATENCY + (8 * manifest.totals.bytes) / (mbit * 1000);
  const full = cellsOf(manifest).map(({ levels }) => levels.length);
  const ssim = judge(manifest, documents.promises)(startView(manifest), full);
  return [NOTHING, { ms, bytes: manifest.totals.bytes, ssim, whole: true, takes: 0 }];
}

/** SSIM over time if increments come six at a time in the order of the manifest. */
export async function fileOrder(documents: Documents, line: Line): Promise<Sample[]> {
  const { clock, network } = linkTo(documents, line);
  const manifest = parseManifest(documents.manifest);
  const ssim = judge(manifest, documents.promises);
  const view = startView(manifest);
  const head = LATENCY + (8 * documents.manifest.length) / (line.mbit * 1000);
  const todo = cellsOf(manifest).flatMap(({ levels }, i) => levels.map((file, k) => ({ file, i, k })));
  const here = cellsOf(manifest).map(() => new Set<number>());
  let bytes = documents.manifest.length;
  const curve: Sample[] = [NOTHING];
  const worker = async (): Promise<void> => {
    for (let next = todo.shift(); next; next = todo.shift()) {
      const { uri, offset, bytes: size } = next.file;
      const headers = offset === undefined ? {} : { Range: `bytes=${offset}-${offset + size - 1}` };
      if (size) await (await network.fetch(new URL(uri, BASE).href, { headers })).text();
      here[next.i]?.add(next.k);
      bytes += next.file.bytes;
      const levels = here.map((set) => {
        let level = 0;
        while (set.has(level)) level += 1;
        return level;
      });
      const whole = !levels.includes(0);
      curve.push({ ms: head + clock.now(), bytes, ssim: ssim(view, levels), whole, takes: 0 });
    }
  };
  const workers = [1, 2, 3, 4, 5, 6].map(worker);
  await clock.pass(60_000);
  await Promise.all(workers);
  return curve;
}

/** One point of a walk. */
export interface Step {
  readonly second: number;
  readonly bytes: number; // received so far
  readonly count: number; // splats drawn
  readonly ssim: number; // expected of what is drawn
  readonly full: number; // expected of everything
}

/** The capture's cameras in order, one a second. */
export async function walked(documents: Documents, line: Line, partial: Partial<Settings>): Promise<Step[]> {
  const { clock, network, renderer } = linkTo(documents, line);
  const manifest = parseManifest(documents.manifest);
  const ssim = judge(manifest, documents.promises);
  const full = cellsOf(manifest).map(({ levels }) => levels.length);
  const settings = { ...FULL, ...partial };
  const { fetch } = network;
  const streamer = new Streamer({ manifest, base: BASE, renderer, settings, clock, fetch, digest: null });
  streamer.start();
  const steps: Step[] = [];
  for (const [second, view] of cameraViews(manifest).entries()) {
    streamer.update(view);
    await clock.pass(1000);
    const { labels, bytesLoaded: bytes, count } = streamer.state;
    const levels = labels.flatMap(({ cells }) => cells.map((cell) => cell.shown));
    steps.push({ second: second + 1, bytes, count, ssim: ssim(view, levels), full: ssim(view, full) });
  }
  streamer.dispose();
  return steps;
}

/** Seconds until a curve reaches a part of its last value for good. */
export function reaches(curve: readonly Sample[], part: number): number {
  const goal = part * (curve.at(-1)?.ssim ?? Number.NaN);
  const below = curve.findLastIndex((sample) => sample.ssim < goal);
  return (curve[below + 1]?.ms ?? Number.NaN) / 1000;
}
