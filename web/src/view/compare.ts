import { Streamer } from "../core/streamer";
import type { Source } from "../inside";
import type { Manifest, Settings } from "../types";
import type { SparkLayer } from "./spark";
import type { Stage } from "./stage";

/** The full scene beside the adapted one, with its own layer and streamer while the comparison is on. */
export class Compare {
  #streamer: Streamer | null = null;
  #layer: SparkLayer | null = null;

  constructor(
    readonly stage: Stage,
    readonly manifest: Manifest,
    readonly source: Source,
    readonly beside: Streamer,
    readonly settings: () => Settings,
  ) {}

  get on(): boolean {
    return this.#layer !== null;
  }

  /** Loaded share of the full scene's bytes, 0 to 1. */
  get progress(): number {
    const shown = this.#streamer?.state.bytesShown ?? 0;
    return shown / Math.max(this.manifest.totals.bytes, 1);
  }

  start(onChange: () => void): void {
    if (this.#layer) return;
    const layer = this.stage.newLayer();
    this.#layer = layer;
    const budget = { bytes: Infinity, gpuBytes: Infinity, count: Infinity };
    const settings: Settings = { ...this.settings(), mode: "full", budget, cacheBytes: 0, aroundBytes: 0 };
    const { manifest, source, beside } = this;
    this.#streamer = new Streamer({ manifest, ...source, renderer: layer, settings, beside });
    this.#streamer.onChange(onChange);
    this.#streamer.start();
    this.stage.full = layer;
    this.stage.invalidate();
  }

  stop(): void {
    this.stage.full = null;
    this.#streamer?.dispose();
    this.#layer?.free();
    this.#streamer = null;
    this.#layer = null;
    this.stage.invalidate();
  }
}
