import { Streamer } from "../core/streamer";
import type { Source } from "../inside";
import type { Manifest, Settings } from "../types";
import type { SparkLayer } from "./spark";
import type { Stage } from "./stage";

/** The full scene beside the adapted one, with its own layer and streamer while the comparison is on. */
export class Compare {
  #streamer: Streamer | null = null;
  #layer: SparkLayer | null = null;
  #isLoaded = false; // all that can be loaded now

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

  start(): void {
    if (this.#layer) return;
    const layer = this.stage.newLayer(() => this.stage.isSplit && this.stage.invalidate());
    this.#layer = layer;
    const budget = { bytes: Infinity, gpuBytes: Infinity, count: Infinity };
    const settings: Settings = { ...this.settings(), mode: "full", budget, cacheBytes: 0, aroundBytes: 0 };
    const { manifest, source, beside } = this;
    this.#streamer = new Streamer({ manifest, ...source, renderer: layer, settings, beside });
    this.#streamer.start();
    void this.#streamer.idle().then(() => {
      if (this.#layer !== layer) return;
      this.#isLoaded = true;
      this.stage.invalidate();
    });
    this.stage.full = layer;
    this.stage.invalidate();
  }

  /** Splits the canvas once the full scene is loaded and sorted; to be called before each frame. */
  update(): void {
    const [layer, { stage }] = [this.#layer, this];
    if (!layer || !this.#isLoaded || stage.isSplit) return;
    stage.isSplit = layer.isCurrent;
    if (stage.isSplit || layer.spark.sorting) return;
    void layer.spark.update({ scene: layer.scene, camera: stage.camera }).then(() => stage.invalidate());
  }

  stop(): void {
    this.stage.full = null;
    this.stage.isSplit = false;
    this.#isLoaded = false;
    this.#streamer?.dispose();
    this.#layer?.free();
    this.#streamer = null;
    this.#layer = null;
    this.stage.invalidate();
  }
}
