import { Color, SRGBColorSpace, Vector3 } from "three";
import { qualitiesOf } from "../core/manifest";
import { Streamer } from "../core/streamer";
import type { Embed, Options, Sample } from "../embed";
import type { Source } from "../inside";
import type { Budget, Manifest, Pose, Quality, Settings, State } from "../types";
import { Bounds } from "./bounds";
import { colorsOf } from "./colors";
import { Compare } from "./compare";
import { Controls } from "./controls";
import { Editor } from "./editor";
import { quat, transformPose, vec3 } from "./frame";
import { type Rig, rigAt } from "./motion";
import { Stage } from "./stage";
import { Headset } from "./xr";

const CACHE = 128e6; // bytes of decoded increments that are not shown
const AROUND = 0.05; // of the scene's bytes, for what a turn of the head shows
const UNLIMITED: Budget = { bytes: Infinity, gpuBytes: Infinity, count: Infinity };
const MAX_PIXEL_RATIO = 2; // device pixels per CSS pixel: more costs fill rate without a visible gain

/** The viewer without its UI: a bundle, a camera, and settings. */
export class Viewer {
  readonly stage: Stage;
  readonly bounds: Bounds;
  readonly controls: Controls;
  readonly streamer: Streamer;
  readonly headset: Headset;
  readonly compare: Compare;
  readonly editor: Editor;
  readonly token: string | null; // with which the server takes edits
  settings: Settings;
  frameMs = Number.NaN; // smoothed; NaN while nothing moves
  photo = -1; // index of the current photo, -1: none
  readonly #life = new AbortController(); // ends with the viewer
  readonly #hidden = new Set<number>();
  readonly #samples = new Set<(sample: Sample) => void>();
  #cap: number | null = null; // splat limit of the headset
  #tint = 0;
  #shaded = false;
  #last = 0;

  /**
   * Throws without WebGL 2.
   *
   * @param keys - what hears the keys that move the camera: the canvas, or the window where the page is the viewer's
   */
  constructor(
    canvas: HTMLCanvasElement,
    readonly manifest: Manifest,
    readonly source: Source,
    options: Options,
    keys: EventTarget,
  ) {
    this.stage = new Stage(canvas, manifest);
    this.settings = startSettings(manifest, options);
    const moved = (rig: Rig, byUser: boolean) => this.#moved(rig, byUser);
    this.bounds = new Bounds(manifest, this.stage.root.clone());
    const { signal } = this.#life;
    this.controls = new Controls(canvas, this.#start(), moved, this.bounds, { keys, signal });
    this.streamer = new Streamer({
      manifest,
      ...source,
      renderer: this.stage.layer,
      settings: this.settings,
    });
    const stop = this.streamer.onChange(() => {
      const { promisesHere } = this.streamer;
      if (!promisesHere) return;
      stop();
      this.bounds.know(promisesHere, manifest.frame);
    });
    this.compare = new Compare(this.stage, manifest, source, this.streamer, () => this.settings);
    this.headset = new Headset(
      this.stage,
      () => this.settings.budget.count,
      (cap) => this.#capped(cap),
    );
    this.editor = new Editor(this);
    this.token = options.edit;
    this.stage.place(this.controls.rig);
    const hidden = manifest.labels.flatMap((label) => (label.hidden ? [label.id] : []));
    if (hidden.length) this.setHidden(hidden, true);
    if (options.view !== null) this.goTo(options.view);
    if (options.pose) this.setPose(options.pose);
  }

  start(): void {
    const { canvas, renderer } = this.stage;
    const resize = () =>
      this.stage.resize(canvas.clientWidth, canvas.clientHeight, Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
    const watch = new ResizeObserver(resize);
    watch.observe(canvas);
    resize();
    const { signal } = this.#life;
    signal.addEventListener("abort", () => watch.disconnect());
    window.addEventListener("online", () => this.streamer.retry(), { signal });
    this.streamer.update(this.stage.viewpoint());
    this.streamer.start();
    renderer.setAnimationLoop((now) => this.#frame(now));
  }

  /** Stops drawing and downloads, frees the memory and removes the canvas. It is of no use afterwards. */
  destroy(): void {
    if (this.#life.signal.aborted) return;
    this.#life.abort();
    this.#samples.clear();
    void this.headset.leave();
    this.compare.stop();
    this.streamer.dispose();
    this.stage.free();
    this.stage.canvas.remove();
  }

  /** Calls back when the browser takes the GPU away, usually for lack of memory; and when it gives it back. */
  onLost(callback: () => void, restored?: () => void): void {
    const { signal } = this.#life;
    this.stage.canvas.addEventListener("webglcontextlost", callback, { signal });
    if (restored) this.stage.canvas.addEventListener("webglcontextrestored", restored, { signal });
  }

  get state(): State {
    return this.streamer.state;
  }

  set(partial: Partial<Settings>): void {
    this.settings = { ...this.settings, ...partial };
    this.#apply();
  }

  isHidden(label: number): boolean {
    return this.#hidden.has(label);
  }

  /** Hides or shows labels; hidden labels use only their first level of the budget. */
  setHidden(labels: readonly number[], hidden: boolean): void {
    for (const label of labels) {
      if (hidden) this.#hidden.add(label);
      else this.#hidden.delete(label);
      for (const layer of [this.stage.layer, this.stage.full]) layer?.setVisible(label, !hidden);
    }
    this.#apply();
  }

  /** Shows the full scene beside the adapted one, with the same tint and hidden labels. */
  startCompare(): void {
    this.compare.start();
    for (const label of this.#hidden) this.stage.full?.setVisible(label, false);
    this.setTint(this.#tint, this.#shaded);
  }

  /** Sets the share of the label colours that is mixed in, 0 to 1; `shaded`: of shades that tell cells apart. */
  setTint(amount: number, shaded = false): void {
    this.#tint = amount;
    this.#shaded = shaded;
    const colors = colorsOf(this.streamer.manifest, shaded);
    for (const layer of [this.stage.layer, this.stage.full]) {
      layer?.setColors(colors);
      layer?.setTint(amount);
    }
  }

  /** The scene's mean colour, 0 to 255: what is behind the picture while something in sight is missing. */
  setMean([red = 0, green = 0, blue = 0]: readonly number[]): void {
    this.stage.mean = new Color().setRGB(red / 255, green / 255, blue / 255, SRGBColorSpace);
    this.stage.invalidate();
  }

  pose(): Pose {
    return this.stage.pose();
  }

  setPose(pose: Pose): void {
    this.photo = -1;
    this.stage.setLens(null, pose.fovY ?? null);
    this.controls.go(this.#rig(pose), false);
  }

  /** Goes to a photo's pose and lens; RangeError for an unknown name or index. */
  goTo(photo: string | number, smooth = false): void {
    const { cameras } = this.manifest;
    const index = typeof photo === "number" ? photo : cameras.findIndex(({ name }) => name === photo);
    const camera = cameras[index];
    if (!camera) throw new RangeError(`No photo ${photo}; there are ${cameras.length}, see \`cameras\`.`);
    this.photo = index;
    this.stage.setLens(camera);
    this.controls.go(this.#rig(camera), smooth);
  }

  onSample(callback: (sample: Sample) => void): () => void {
    this.#samples.add(callback);
    this.stage.invalidate();
    return () => this.#samples.delete(callback);
  }

  #start(): Rig {
    const { start } = this.manifest;
    return this.#rig(start, start.target);
  }

  #rig(pose: Pose, target: Pose["position"] = this.manifest.start.target): Rig {
    const { position, quaternion } = transformPose(pose, this.stage.root);
    const reach = new Vector3(...target).applyMatrix4(this.stage.root).distanceTo(new Vector3(...position));
    return rigAt(position, quaternion, reach);
  }

  #moved(rig: Rig, byUser: boolean): void {
    if (byUser && this.photo >= 0) this.photo = -1;
    this.stage.place(rig);
  }

  #apply(): void {
    const weights = new Map(this.settings.weights);
    for (const label of this.#hidden) weights.set(label, 0);
    const count = Math.min(this.settings.budget.count, this.#cap ?? Infinity);
    this.streamer.set({ ...this.settings, weights, budget: { ...this.settings.budget, count } });
    this.stage.invalidate();
  }

  #capped(cap: number | null): void {
    this.#cap = cap;
    this.#apply();
    if (cap === null) this.#landed();
  }

  /** Ends a headset session; the camera stays at the head's pose. */
  #landed(): void {
    const { position, quaternion } = this.stage.camera;
    this.controls.go(rigAt(vec3(position), quat(quaternion), this.controls.rig.reach), false);
  }

  #frame(now: number): void {
    const seconds = Math.min((now - this.#last) / 1000, 0.1);
    const frameMs = now - this.#last;
    this.#last = now;
    const { stage, headset } = this;
    if (headset.session) headset.update(frameMs / 1000, this.state.count);
    else this.controls.update(seconds);
    const { clientWidth, clientHeight } = stage.canvas;
    const visible = clientWidth > 0 && clientHeight > 0;
    if (!headset.session && !(stage.needsFrame && visible)) {
      this.frameMs = Number.NaN;
      return;
    }
    stage.isIncomplete = this.state.labels.some(({ cells }) =>
      cells.some((cell) => cell.visible && !cell.shown),
    );
    this.compare.update();
    const isDrawn = stage.draw(true);
    this.streamer.update(stage.viewpoint());
    if (!isDrawn) return;
    this.frameMs = Number.isNaN(this.frameMs) ? frameMs : this.frameMs + (frameMs - this.frameMs) * 0.1;
    this.#sample(now, frameMs);
  }

  #sample(time: number, frameMs: number): void {
    if (!this.#samples.size) return;
    const { stage, headset, state } = this;
    const sample: Sample = {
      time,
      frameMs,
      drawn: stage.layer.spark.activeSplats,
      settled: stage.layer.settled && (stage.full?.settled ?? true),
      textures: stage.renderer.info.memory.textures,
      presenting: headset.session !== null,
      cap: this.#cap ?? Infinity,
      state,
    };
    for (const callback of this.#samples) callback(sample);
  }
}

/** Targets to begin with, where the bundle says none of the quality. */
export const DEFAULT_TARGETS: Readonly<Record<Quality, number>> = { fidelity: 0.95, ssim: 0.7 };

function startSettings(manifest: Manifest, options: Options): Settings {
  const quality = options.quality ?? manifest.target.quality;
  const known = qualitiesOf(manifest);
  if (known.length && !known.includes(quality)) {
    throw new Error(`?quality=${quality}: this bundle has only ${known.join(" and ")}; correct the address.`);
  }
  const usual = quality === manifest.target.quality ? manifest.target.value : DEFAULT_TARGETS[quality];
  const bytes = options.budget === null ? Infinity : options.budget * 1e6;
  return {
    mode: options.budget !== null && options.target === null ? "budget" : "target",
    quality,
    target: options.target ?? usual,
    budget: { ...UNLIMITED, bytes },
    weights: new Map(manifest.labels.map(({ id, weight }) => [id, weight])),
    cacheBytes: CACHE,
    aroundBytes: AROUND * manifest.totals.bytes,
  };
}

/** The viewer's interface for other scripts on the page. */
export function embed(viewer: Viewer): Embed {
  return {
    version: viewer.manifest.generator,
    cameras: viewer.manifest.cameras,
    state: () => viewer.state,
    settings: () => viewer.settings,
    set: (partial) => viewer.set(partial),
    pose: () => viewer.pose(),
    setPose: (pose) => viewer.setPose(pose),
    goTo: (photo) => viewer.goTo(photo),
    onSample: (callback) => viewer.onSample(callback),
    destroy: () => viewer.destroy(),
  };
}
