/** Streams a bundle: plans, downloads, decodes and draws increments. The only stateful part of the core. */

import type {
  Handle,
  Level,
  Manifest,
  Promises,
  Quality,
  Renderer,
  Screens,
  Settings,
  State,
  Viewpoint,
} from "../types";
import { describe } from "./describe";
import { rotate } from "./distance";
import { type Clock, clockOfBrowser, type Digest, digestOfBrowser, type Fetch, type File } from "./download";
import { Downloads, TRIES_BEFORE_NOTICE } from "./downloads";
import { normalised, same } from "./inputs";
import { poll } from "./live";
import { parsePromises } from "./manifest";
import { inOrder } from "./order";
import { Pack } from "./pack";
import { makePlan, type Plan } from "./planner";
import { screenOf } from "./quality";
import { type Drawn, type Entry, entriesOf, exchange, gpuBytesOf, Hidden, settle } from "./residency";
import { type Family, familiesOf, ViewpointModels } from "./viewpoints";

export interface StreamerOptions {
  readonly manifest: Manifest;
  readonly base: URL; // of the bundle's folder, ending in a slash
  readonly renderer: Renderer;
  readonly settings: Settings;
  readonly fetch?: Fetch;
  readonly clock?: Clock;
  readonly now?: () => number; // ms, instead of the clock's
  readonly digest?: Digest;
  readonly keepBytes?: number; // cache of downloaded files
  readonly beside?: Streamer; // one of the same bundle: what it has fetched is not fetched again
  readonly downloads?: number; // concurrent downloads, at most
}

const PLAN_EVERY = 125; // ms between plans, at least
const PAUSE = 4; // least pause after a plan, as a multiple of its duration, so that large scenes leave time to draw
const QUICK_MS = 4; // ms; plans that are faster need no pause
const FILE_CACHE_BYTES = 64 * 2 ** 20;
const MAX_DECODES = 4; // concurrent
const DELAYING_SHARE = 0.05; // size of the viewpoint models, relative to a pack, from which on they delay it
const WITHOUT_MODELS = "levels are planned by what holds for all viewpoints.";
const LENS = [0.8, 0.5] as const; // until there is a viewpoint
const UNCHECKED = "Served without https: files are checked by their size only.";

/** All that pictures are drawn from, in the order of their ranges: palettes and levels. */
export const filesToDraw = ({ labels }: Manifest): File[] =>
  labels.flatMap(({ palette, cells }) => [
    ...(palette ? [palette] : []),
    ...cells.flatMap(({ levels }) => levels),
  ]);

export class Streamer {
  private readonly renderer: Renderer;
  private readonly clock: Clock;
  private readonly downloads: Downloads;
  private readonly digest: Digest;
  private readonly hidden: Hidden;
  private readonly listeners = new Set<() => void>();
  private waiting: (() => void)[] = [];
  private settings: Settings;
  private viewpoint: Viewpoint;
  private content: Manifest;
  private families: Family[];
  private entries: Entry[]; // of all families
  private leaving: Drawn[] = []; // drawn increments of cells that a new manifest removed
  private modelsByQuality = new Map<Quality, ViewpointModels>(); // those that were asked for
  private planned: Plan["status"] = "ok";
  private nextPlan = -Infinity; // ms of the clock: earliest time
  private nextWork = -Infinity;
  private postponed = false; // an update is scheduled
  private readonly palettes = new Map<string, Uint8Array>(); // that have arrived, by hash
  private wantedKeys = new Set<string>(); // of all files of the plan
  private dirty = false;
  private decodes = 0;
  private pending = 0;
  private trouble: string | null = null;
  private known: State | null = null;
  private notified = true;
  private phase: "new" | "running" | "disposed" = "new";

  constructor(private readonly options: StreamerOptions) {
    const { manifest, renderer, settings } = options;
    const clock = options.clock ?? clockOfBrowser;
    this.clock = { after: (ms, run) => clock.after(ms, run), now: options.now ?? (() => clock.now()) };
    this.renderer = renderer;
    this.settings = normalised(settings);
    this.content = manifest;
    this.entries = entriesOf(manifest.labels);
    this.families = familiesOf(this.entries);
    this.hidden = new Hidden(renderer);
    this.digest = options.digest === undefined ? digestOfBrowser : options.digest;
    this.downloads = new Downloads({
      base: options.base,
      fetch: options.fetch ?? ((url, init) => fetch(url, init)),
      clock: this.clock,
      digest: this.digest,
      keepBytes: options.keepBytes ?? FILE_CACHE_BYTES,
      cache: options.beside?.downloads.cache,
      changed: () => this.arrived(),
      ...(options.downloads && { maxDownloads: options.downloads }),
    });
    this.downloads.setRanges(filesToDraw(manifest));
    const { position, quaternion } = manifest.start;
    this.viewpoint = { position, direction: rotate(quaternion, [0, 0, -1]), frustum: [], lens: LENS };
  }

  /** The manifest in use; in a live bundle it changes. */
  get manifest(): Manifest {
    return this.content;
  }

  get state(): State {
    if (this.known?.bytesLoaded !== this.downloads.received) this.known = null;
    this.known ??= this.describe();
    return this.known;
  }

  /** Takes contents of files, by key, that need no download; to be called before the start. */
  know(contents: ReadonlyMap<string, Uint8Array>): void {
    for (const [key, content] of contents) this.downloads.cache.put(key, content);
  }

  /** Contents of the files to draw that are here, by key. */
  get contents(): [string, Uint8Array][] {
    const keys = new Set(filesToDraw(this.content).map(({ key }) => key));
    return [...this.downloads.cache.entries()].filter(([key]) => keys.has(key));
  }

  /** The viewpoint models that are planned with, once they are there. */
  get promisesHere(): Promises | null {
    return this.models.promises;
  }

  /** Starts loading, for the bundle's start view until `update` is called. */
  start(): void {
    if (this.phase !== "new") return;
    this.phase = "running";
    if (this.content.pack && !this.options.beside) this.downloads.openPack(new Pack(this.content));
    this.plan();
    if (this.content.live) this.follow();
  }

  /** Sets the viewpoint. Cheap: plans at most 8 times a second, and only if something moved. */
  update(viewpoint: Viewpoint): void {
    if (same(viewpoint, this.viewpoint)) return;
    this.viewpoint = viewpoint;
    this.replan();
  }

  set(partial: Partial<Settings>): void {
    this.settings = normalised({ ...this.settings, ...partial });
    this.hidden.shrink(this.settings.cacheBytes);
    this.replan();
  }

  /** Calls back, at most once per task, when the state has changed. Returns a function that unsubscribes. */
  onChange(callback: () => void): () => void {
    this.listeners.add(callback);
    return () => this.listeners.delete(callback);
  }

  /** Resolves when everything planned is drawn, or currently unavailable. */
  idle(): Promise<void> {
    return new Promise((resolve) => {
      this.waiting.push(resolve);
      this.rest();
    });
  }

  /** Retries failed downloads immediately, e.g. when the browser is online again. */
  retry(): void {
    this.downloads.clearFailures();
    this.trouble = null;
    this.replan();
  }

  dispose(): void {
    if (this.phase === "disposed") return;
    this.phase = "disposed";
    this.downloads.close();
    const former = [...this.leaving, ...this.entries.flatMap((e) => e.former ?? [])].flatMap(
      (d) => d.handles,
    );
    const all = [...former, ...this.entries.flatMap((e) => e.handles(0, e.decoded.length))];
    this.renderer.swap([], [...former, ...this.entries.flatMap((e) => e.drawn(e.shown))]);
    for (const handle of all) this.renderer.dispose(handle);
    this.entries = [];
    this.families = [];
    this.leaving = [];
    this.known = null;
    this.listeners.clear();
    this.rest();
  }

  private replan(): void {
    if (this.phase !== "running" || this.dirty) return;
    const wait = this.nextPlan - this.clock.now();
    this.dirty = wait > 0;
    if (this.dirty) this.clock.after(wait, () => this.phase === "running" && this.plan());
    else this.plan();
  }

  private plan(): void {
    this.dirty = false;
    const begun = this.clock.now();
    const { models } = this;
    models.see(this.families, this.viewpoint);
    const isHere = (file: File) => this.palettes.has(file.key) || this.downloads.isHere(file);
    const groups = this.families.map((family) => {
      return models.group(family, this.settings, (entry) => this.highest(entry), isHere);
    });
    const { wanted, around, status } = makePlan(groups, this.settings);
    this.planned = status;
    this.families.forEach(({ entries }, i) => {
      entries.forEach((entry, j) => {
        const cell = models.isByLabel ? 0 : j;
        const highest = this.highest(entry);
        entry.planned = Math.min(wanted[i]?.[cell] ?? 0, highest);
        entry.around = Math.min(around[i]?.[cell] ?? 0, highest);
      });
    });
    this.aim();
    const took = this.clock.now() - begun;
    this.nextPlan = begun + Math.max(PLAN_EVERY, (1 + PAUSE) * took);
    this.work();
  }

  /**
   * Sets the levels to go for: cells out of sight are raised once everything in sight is drawn as planned, unless
   * the server would send all of their levels.
   */
  private aim(): void {
    const canRaise = this.downloads.sendsRanges !== false;
    const isDrawn =
      canRaise && this.entries.every(({ sight, shown, planned }) => !sight.visible || shown >= planned);
    for (const e of this.entries) {
      const most = isDrawn ? e.around : Math.min(e.shown, e.around);
      e.wanted = e.sight.visible ? e.planned : Math.max(e.planned, most);
    }
    this.wantedKeys = new Set(this.entries.flatMap((e) => e.path.map((f) => f.file.key)));
    if (this.promises) this.wantedKeys.add(this.promises.key);
    for (const { label } of this.entries) if (label.palette) this.wantedKeys.add(label.palette.key);
  }

  /** Highest available level of a cell: below its first damaged increment. */
  private highest(entry: Entry): number {
    const broken = entry.cell.levels.findIndex((file, i) => {
      const palette = entry.paletteOf(i + 1);
      return [file, ...(palette ? [palette] : [])].some((one) => this.downloads.failure(one)?.lasting);
    });
    return broken < 0 ? entry.cell.levels.length : broken;
  }

  /** Draws decoded increments, decodes downloaded ones, downloads missing ones. */
  private work(): void {
    if (this.phase !== "running" || this.postponed) return;
    const begun = this.clock.now();
    if (begun < this.nextWork) {
      this.postponed = true;
      this.clock.after(this.nextWork - begun, () => {
        this.postponed = false;
        this.work();
      });
      return;
    }
    this.draw();
    if (this.entries.some(({ wanted, around }) => wanted < around)) this.aim();
    this.hidden.shrink(this.settings.cacheBytes);
    this.decodeMore();
    const promises = this.missingPromises();
    const models = this.isUndecided(promises) ? "awaited" : this.promisesCanWait() ? "last" : "first";
    const planned = inOrder(this.entries, this.downloads, promises, models);
    const queue = models === "awaited" ? planned : [...this.missingPalettes(), ...planned];
    this.pending = queue.length;
    this.downloads.keepOnly(this.wantedKeys);
    this.downloads.fill(queue);
    const took = this.clock.now() - begun;
    if (took > QUICK_MS) this.nextWork = begun + (1 + PAUSE) * took;
    this.changed();
    this.rest();
  }

  private draw(): void {
    try {
      settle(this.entries, this.leaving, this.hidden, this.renderer);
    } catch (error) {
      this.trouble = `Drawing failed (${error instanceof Error ? error.message : error}); reload the page.`;
    }
  }

  /** Whether missing viewpoint models will change the plan. */
  private isUndecided(promises: readonly File[]): boolean {
    return this.dependsOnModels && promises.some((file) => !this.downloads.isBackingOff(file));
  }

  private get dependsOnModels(): boolean {
    const { mode } = this.settings;
    return this.planned !== "ok" || (mode !== "full" && mode !== "base");
  }

  /** Whether viewpoint models can wait: the plan does not depend on them, and they would delay a small pack. */
  private promisesCanWait(): boolean {
    const { promises, content } = this;
    const { pack } = content;
    if (!this.downloads.hasPack || this.dependsOnModels) return false;
    return (promises?.bytes ?? 0) > DELAYING_SHARE * (pack?.bytes ?? 0);
  }

  /** The palettes that have not arrived of levels that are next. */
  private missingPalettes(): File[] {
    const needed = this.entries.flatMap((entry) => (entry.next && entry.paletteOf(entry.next)) || []);
    return [...new Set(needed)].filter((palette) => !this.contentOf(palette));
  }

  /** A palette, if it has arrived or is known. */
  private contentOf(palette: File): Uint8Array | undefined {
    const content = this.palettes.get(palette.key) ?? this.downloads.take(palette);
    if (content) this.palettes.set(palette.key, content);
    return content;
  }

  private missingPromises(): File[] {
    return this.promises && !this.models.complete ? [this.promises] : [];
  }

  /** The file with the viewpoint models of the quality that is asked for, if the bundle has one. */
  private get promises(): File | undefined {
    return this.content.promises[this.settings.quality];
  }

  private get models(): ViewpointModels {
    const { quality } = this.settings;
    const known = this.modelsByQuality.get(quality) ?? new ViewpointModels(quality, this.content.labels);
    this.modelsByQuality.set(quality, known);
    return known;
  }

  /** Files of all planned increments that are not decoded. */
  private wantedFiles(): File[] {
    return this.entries.flatMap((entry) => {
      return entry.path.flatMap(({ file, level }) => (entry.has(level) ? [] : file));
    });
  }

  /** Decodes in the order of arrival, which is that of value. */
  private decodeMore(): void {
    const came = this.downloads.arrivals;
    const place = (entry: Entry) => came.get(entry.cell.levels[entry.next - 1]?.key ?? "") ?? -1;
    for (const entry of [...this.entries].sort((a, b) => place(a) - place(b))) this.decodeNext(entry);
  }

  private decodeNext(entry: Entry): void {
    const level = entry.next;
    const file = entry.cell.levels[level - 1];
    if (!file || entry.decoding || this.decodes >= MAX_DECODES) return;
    if (this.downloads.failure(file)?.lasting) return;
    const palette = entry.paletteOf(level);
    const bytes = palette && this.contentOf(palette);
    if (palette && !bytes) return;
    const content = entry.contents[level - 1] ?? this.downloads.take(file);
    const known = palette && bytes && { key: palette.key, bytes };
    if (content) void this.decode(entry, file, level, content, known);
  }

  private async decode(
    entry: Entry,
    file: Level,
    level: number,
    content: Uint8Array,
    palette: Parameters<Renderer["decode"]>[6],
  ): Promise<void> {
    entry.decoding = level;
    this.decodes += 1;
    let handle: Handle | undefined;
    try {
      const { label, cell } = entry;
      const below = entry.below(level);
      handle = await this.renderer.decode(label.id, cell.id, level, content, file.format, below, palette);
      if (file.format === "stream") entry.contents[level - 1] = content;
    } catch {
      this.downloads.markCorrupt(file, `${file.uri} cannot be decoded`);
    }
    entry.decoding = 0;
    this.decodes -= 1;
    if (handle && (this.phase === "disposed" || !this.entries.includes(entry))) this.renderer.dispose(handle);
    else if (handle) {
      entry.decoded[level - 1] = handle;
      if (!entry.path.some((one) => one.level === level)) this.hidden.add(entry, handle);
    }
    if (this.phase !== "running") return;
    if (handle) this.work();
    else this.arrived();
  }

  /** Called when a file has arrived, has failed, or may be retried. */
  private arrived(): void {
    if (this.phase !== "running") return;
    this.takePromises();
    const capped = this.entries.some((entry) => entry.wanted > this.highest(entry));
    if (capped) this.plan();
    else this.work();
  }

  private takePromises(): void {
    const { quality } = this.settings;
    for (const file of this.missingPromises()) {
      const content = this.downloads.take(file);
      if (!content) return;
      try {
        const promises = parsePromises(new TextDecoder().decode(content), file.uri, quality);
        this.modelsByQuality.set(quality, new ViewpointModels(quality, this.content.labels, promises));
        this.replan();
      } catch (error) {
        this.downloads.markCorrupt(
          file,
          error instanceof Error ? error.message : `${file.uri} cannot be read`,
        );
      }
    }
  }

  /** Adopts the manifest of a live bundle whenever it has changed and the previous one is drawn. */
  private follow(): void {
    const { base, fetch = (url, init) => globalThis.fetch(url, init) } = this.options;
    poll({
      url: new URL("manifest.json", base).href,
      fetch,
      clock: this.clock,
      isActive: () => this.phase === "running" && this.content.live,
      isFree: () => this.isIdle(),
      changed: (manifest) => this.adopt(manifest),
      failed: (message) => {
        this.trouble = message;
        this.changed();
      },
    });
  }

  private adopt(manifest: Manifest): void {
    const { entries, leaving } = exchange(this.entries, manifest.labels, this.hidden, this.renderer);
    this.entries = entries;
    this.families = familiesOf(entries);
    this.leaving.push(...leaving);
    this.modelsByQuality.clear();
    this.content = manifest;
    this.downloads.setRanges(filesToDraw(manifest));
    this.trouble = null;
    this.downloads.clearFailures();
    this.plan();
  }

  private isIdle(): boolean {
    if (this.phase !== "running") return true;
    return (
      !this.dirty &&
      !this.postponed &&
      !this.downloads.running &&
      !this.decodes &&
      !this.pending &&
      !this.retrying()
    );
  }

  /** Whether a failed download will soon be retried. */
  private retrying(): boolean {
    return [...this.wantedFiles(), ...this.missingPromises(), ...this.missingPalettes()].some((file) => {
      const failure = this.downloads.failure(file);
      return failure !== undefined && !failure.lasting && failure.tries < TRIES_BEFORE_NOTICE;
    });
  }

  private rest(): void {
    if (!this.waiting.length || !this.isIdle()) return;
    for (const resolve of this.waiting.splice(0)) resolve();
  }

  private changed(): void {
    this.known = null;
    if (!this.notified) return;
    this.notified = false;
    queueMicrotask(() => {
      this.notified = true;
      for (const callback of this.listeners) callback();
    });
  }

  private screens(): Screens | null {
    const { promises } = this.models;
    if (!promises) return null;
    const [least, most] = promises.screens;
    return { least, most, here: screenOf(this.viewpoint, promises), fov: promises.fov };
  }

  private describe(): State {
    const promises = this.promises && this.downloads.failure(this.promises);
    return describe(this.families, {
      planned: this.planned,
      bytesLoaded: this.downloads.received,
      bandwidth: this.downloads.bandwidth.rate,
      pending: this.pending,
      leavingBytes: this.leaving.reduce((sum, drawn) => sum + gpuBytesOf(drawn), 0),
      screens: this.screens(),
      asked: this.settings.mode === "target" ? this.settings.target : Infinity,
      notes: [
        this.trouble,
        this.downloads.note,
        promises &&
          (promises.lasting || promises.tries >= TRIES_BEFORE_NOTICE) &&
          `${promises.message}; ${WITHOUT_MODELS}`,
        !this.digest && UNCHECKED,
      ].map((note) => note || null),
      failure: (entry, level) => {
        const files = [entry.cell.levels[level - 1], entry.paletteOf(level)];
        const failures = files.map((file) => file && this.downloads.failure(file));
        return failures.find((failure) => failure !== undefined);
      },
    });
  }
}
