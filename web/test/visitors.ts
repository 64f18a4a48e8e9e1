/** Visitors of a bundle: how long they stay, where they walk, and what their browsers ask a server for. */

import { rotate } from "../src/core/distance";
import type { Fetch } from "../src/core/download";
import { loadManifest, parseManifest } from "../src/core/manifest";
import { Streamer } from "../src/core/streamer";
import type { Level, Manifest, Quat, Settings, Vec3, Viewpoint } from "../src/types";
import { FakeRenderer, Network, putIncrements, rangeOf, seeded, VirtualClock } from "./simulate";
import { BASE, documentOf, frustumOf, lensOf, NO_BUDGET } from "./worlds";

/** A file of a bundle, as a server has it. */
export interface Served {
  readonly uri: string;
  readonly wire: number; // bytes over the network, with gzip where a server uses it
  readonly text?: string; // of what the viewer reads
}

/** A kind of visitor: device, link and what is asked of the viewer. */
export interface Profile {
  readonly name: string;
  readonly mbit: number;
  readonly aspect: number; // of the canvas, width over height
  readonly settings: (manifest: Manifest) => Partial<Settings>;
}

export const LATENCY = 100; // ms
const MEAN_STAY = 60; // s: a page is looked at for a little less than a minute on average
const SHAPE = 0.75; // of the Weibull distribution; below 1: who has stayed is more likely to stay on
const GAMMA = 1.1906; // of 1 + 1 / SHAPE
const SPEED = 1.2; // m/s
const STEP = 500; // ms
const FOV_Y = 0.9; // radians

const phone = ({ totals }: Manifest): Partial<Settings> => ({
  mode: "budget",
  budget: { ...NO_BUDGET, bytes: totals.bytes / 2 },
});

const TARGET: Partial<Settings> = { mode: "target", quality: "fidelity", target: 0.95 };

export const PROFILES: readonly Profile[] = [
  { name: "everything", mbit: 50, aspect: 1.6, settings: () => ({ mode: "full" }) },
  { name: "fidelity 0.95", mbit: 50, aspect: 1.6, settings: () => TARGET },
  { name: "fidelity 0.95, phone", mbit: 10, aspect: 0.5, settings: () => TARGET },
  { name: "half of the bytes, phone", mbit: 10, aspect: 0.5, settings: phone },
];

/** Seconds that each of so many visitors stays: the middle of each quantile, shuffled. */
export function stays(count: number, seed: number): number[] {
  const random = seeded(seed);
  const all = Array.from({ length: count }, (_, i) => {
    return (MEAN_STAY / GAMMA) * (-Math.log(1 - (i + 0.5) / count)) ** (1 / SHAPE);
  });
  for (let i = all.length - 1; i > 0; i--) {
    const j = Math.floor(random() * (i + 1));
    [all[i], all[j]] = [all[j] as number, all[i] as number];
  }
  return all;
}

interface Pose {
  readonly position: Vec3;
  readonly quaternion: Quat;
}

/** A path from the bundle's start: to the next photos or to one nearby, with pauses. Says the pose at a time. */
export function path(manifest: Manifest, seconds: number, seed: number): (second: number) => Pose {
  const random = seeded(seed);
  const { cameras, frame } = manifest;
  const speed = SPEED / frame.metersPerUnit; // units a second
  const legs: { from: Pose; to: Pose; begin: number; end: number }[] = [];
  let from: Pose = manifest.start;
  let now = 1 + 4 * random();
  let at = nearest(cameras, from.position)[0] ?? 0;
  const seen = new Set<number>([at]);
  while (now < seconds && cameras.length > 1) {
    const near = nearest(cameras, from.position).filter((i) => !seen.has(i));
    const next = (at + 1) % cameras.length;
    // along the photos as they were taken, or across to one of the twenty nearest
    const along = random() < 0.7 && !seen.has(next);
    at = along ? next : (near[Math.floor(random() * Math.min(near.length, 20))] ?? next);
    if (seen.size > cameras.length / 2) seen.clear();
    seen.add(at);
    const to = cameras[at] as Pose;
    const end = now + Math.max(distance(from.position, to.position) / speed, 0.5);
    legs.push({ from, to, begin: now, end });
    now = end + (random() < 0.3 ? 1 + 4 * random() : 0);
    from = to;
  }
  return (second) => {
    const leg = legs.findLast(({ begin }) => begin <= second);
    if (!leg) return manifest.start;
    const t = Math.min((second - leg.begin) / (leg.end - leg.begin), 1);
    return {
      position: mix(leg.from.position, leg.to.position, t),
      quaternion: turn(leg.from.quaternion, leg.to.quaternion, t),
    };
  };
}

const distance = (a: Vec3, b: Vec3): number => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

/** Indices of the cameras, the nearest first. */
const nearest = (cameras: Manifest["cameras"], from: Vec3): number[] =>
  cameras
    .map(({ position }, i) => ({ i, away: distance(position, from) }))
    .sort((a, b) => a.away - b.away)
    .map(({ i }) => i);

const mix = (a: Vec3, b: Vec3, t: number): Vec3 => [
  a[0] + (b[0] - a[0]) * t,
  a[1] + (b[1] - a[1]) * t,
  a[2] + (b[2] - a[2]) * t,
];

/** The short way round, by normalised mixing. */
function turn(a: Quat, b: Quat, t: number): Quat {
  const sign = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? -1 : 1;
  const [x, y, z, w] = a.map((value, i) => value * (1 - t) + sign * (b[i] as number) * t) as [
    number,
    number,
    number,
    number,
  ];
  const size = Math.hypot(x, y, z, w) || 1;
  return [x / size, y / size, z / size, w / size];
}

/** One request: ms since the visitor came, path, bytes of the range that was asked for, and of what came. */
export interface Request {
  readonly ms: number;
  readonly uri: string;
  readonly asked?: number;
  bytes: number;
}

/** A `fetch` that writes down what is asked for and how much of it comes. */
function recording(network: Network, clock: VirtualClock, log: Request[]): Fetch {
  return async (url, init) => {
    const uri = new URL(url).pathname.slice(1);
    const range = rangeOf(init);
    const asked = range ? { asked: Number(range[2]) - Number(range[1]) + 1 } : {};
    const entry: Request = { ms: Math.round(clock.now()), uri, ...asked, bytes: 0 };
    log.push(entry);
    const reply = await network.fetch(url, init);
    const { body } = reply;
    const reader = body?.getReader();
    const read = async () => {
      const next = await (reader as NonNullable<typeof reader>).read();
      entry.bytes += next.value?.length ?? 0;
      return next;
    };
    const text = async () => {
      const decoder = new TextDecoder();
      let found = "";
      for (let next = await read(); !next.done; next = await read()) {
        found += decoder.decode(next.value, { stream: true });
      }
      return found;
    };
    return { ...reply, text, body: reader ? { getReader: () => ({ read }) } : null };
  };
}

/** A bundle's manifest whose increments have so many times the bytes. */
export function resized(json: string, scale: number): Manifest {
  const manifest = parseManifest(json);
  const resize = (level: Level): Level => ({
    ...level,
    bytes: level.bytes * scale,
    ...(level.offset !== undefined && { offset: level.offset * scale }),
  });
  const labels = manifest.labels.map((label) => ({
    ...label,
    cells: label.cells.map((cell) => ({ ...cell, levels: cell.levels.map(resize) })),
  }));
  const totals = { ...manifest.totals, bytes: manifest.totals.bytes * scale };
  const pack = manifest.pack && { ...manifest.pack, bytes: manifest.pack.bytes * scale };
  return { ...manifest, labels, totals, pack };
}

export const textOf = (manifest: Manifest): string => JSON.stringify(documentOf(manifest));

/** Everything that a manifest names, with the files of the page. */
function serve(network: Network, manifest: Manifest, files: readonly Served[]): void {
  for (const { uri, wire, text } of files) {
    network.files.set(uri, text === undefined ? new Uint8Array(wire) : new TextEncoder().encode(text));
  }
  network.files.set("manifest.json", new TextEncoder().encode(textOf(manifest)));
  putIncrements(network, manifest);
}

/** The page as a browser loads it: HTML, then what it names, at once. */
async function openPage(fetch: Fetch, files: readonly Served[]): Promise<void> {
  const get = async (uri: string) => (await fetch(new URL(uri, BASE).href)).text();
  await get("index.html");
  const named = files.map(({ uri }) => uri).filter((uri) => /^assets\/|^poster/.test(uri));
  const [poster, assets] = [named.filter((u) => u.startsWith("poster")), named.filter((u) => u[0] === "a")];
  for (const uri of poster) void get(uri);
  await Promise.all(assets.map(get));
}

/** Requests of one visitor with an empty cache who walks for so many seconds and leaves. */
export async function visit(
  manifest: Manifest,
  files: readonly Served[],
  profile: Profile,
  seconds: number,
  seed: number,
): Promise<Request[]> {
  const clock = new VirtualClock();
  const network = new Network(clock, (profile.mbit * 1e6) / 8, LATENCY, Infinity);
  serve(network, manifest, files);
  const log: Request[] = [];
  const fetch = recording(network, clock, log);
  const settings: Settings = {
    mode: "target",
    quality: "fidelity",
    target: 0.95,
    budget: NO_BUDGET,
    weights: new Map(manifest.labels.map(({ id, weight }) => [id, weight])),
    cacheBytes: 128e6,
    aroundBytes: 0.05 * manifest.totals.bytes,
    ...profile.settings(manifest),
  };
  const poseAt = path(manifest, seconds, seed);
  let [streamer, began]: [Streamer | null, number] = [null, 0];
  const view = (): Viewpoint => {
    const { position, quaternion } = poseAt((clock.now() - began) / 1000);
    const frustum = frustumOf(position, quaternion, FOV_Y, profile.aspect);
    return {
      position,
      direction: rotate(quaternion, [0, 0, -1]),
      frustum,
      lens: lensOf(FOV_Y, profile.aspect),
    };
  };
  const open = async () => {
    await openPage(fetch, files);
    const found = await loadManifest(BASE, fetch);
    const renderer = new FakeRenderer(clock);
    began = clock.now();
    streamer = new Streamer({ manifest: found, base: BASE, renderer, settings, clock, fetch, digest: null });
    streamer.update(view());
    streamer.start();
  };
  void open();
  for (let left = 1000 * seconds; left > 0; left -= STEP) {
    (streamer as Streamer | null)?.update(view());
    await clock.pass(Math.min(STEP, left));
  }
  (streamer as Streamer | null)?.dispose();
  return log;
}
