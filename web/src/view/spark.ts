import { dyno, type PackedSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Group, type Matrix4, Scene, Vector3, type WebGLRenderer } from "three";
import type { Encoding, Packed } from "../core/pick";
import type { Format, Handle, Manifest, Renderer } from "../types";
import { type Answer, Decoders } from "./decoding";
import StreamWorker from "./decoding.worker?worker&inline";
import { rootMatrix } from "./frame";
import { blendOpacities } from "./opacity";
import { ENCODING, type Part } from "./packing";
import { decodePart, joined } from "./splats";

type Color = InstanceType<typeof dyno.DynoVec3<Vector3>>;

/** A decoded increment. */
interface Increment extends Handle {
  readonly part: Part;
}

/**
 * A label's increments as one mesh: first the shown ones, by level, then those hidden since. There is one mesh
 * per label, since Spark pads every mesh to 2048 splats and draws each with its own call.
 */
interface Column {
  readonly mesh: SplatMesh;
  readonly source: Source;
  readonly color: Color;
  shown: readonly Increment[];
  stored: readonly Increment[];
  weight: number; // of the second opacities in what is stored
  marks: Uint8Array | null; // by splat, one of `Mark`
}

/** How a splat is drawn while labels are edited. */
export const Mark = { plain: 0, lit: 1, hidden: 2 } as const;
const LIT = [255, 190, 40] as const; // colour that lit splats are mixed with
const LIT_SHARE = 0.65;

/** A view of the shown prefix of the stored splats: going down a level needs no upload. */
class Source {
  count = 0;
  constructor(public splats: PackedSplats) {}
  prepareFetchSplat = () => this.splats.prepareFetchSplat();
  dispose = () => this.splats.dispose();
  getNumSplats = () => this.count;
  hasRgbDir = () => this.splats.hasRgbDir();
  getNumSh = () => this.splats.getNumSh();
  setMaxSh = (degree: number) => this.splats.setMaxSh(degree);
  fetchSplat: PackedSplats["fetchSplat"] = (at) => this.splats.fetchSplat(at);
  forEachSplat: PackedSplats["forEachSplat"] = (callback) => this.splats.forEachSplat(callback);
}

/** Draws all labels of a scene with Spark; increments can be added and removed without visible gaps. */
export class SparkLayer implements Renderer {
  readonly scene = new Scene();
  readonly root = new Group();
  readonly spark: SparkRenderer;
  readonly #columns = new Map<number, Column>();
  readonly #colors = new Map<number, string>();
  readonly #weights: ReadonlyMap<number, readonly (number | undefined)[]>; // of second opacities, by label and level
  readonly #decoders = new Decoders(startWorker);
  readonly #tint = new dyno.DynoFloat({ value: 0 });
  readonly #dirty: () => void;

  /** @param onDirty - called when a new frame is needed: something was shown, hidden or sorted */
  constructor(renderer: WebGLRenderer, manifest: Manifest, onDirty: () => void) {
    this.#dirty = onDirty;
    this.spark = new SparkRenderer({
      renderer,
      onDirty,
      enableLod: false,
      sortRadial: false, // as in training
      accumExtSplats: true, // keeps colours above 1 until blending
      maxStdDev: 3.33, // where an opaque splat's alpha falls below 1/255
      clipXY: 2, // large splats can extend into the image from outside
      maxPixelRadius: 2048,
      preBlurAmount: manifest.antialiased ? 0 : 0.3,
      blurAmount: manifest.antialiased ? 0.3 : 0,
    });
    this.#weights = new Map(manifest.labels.map(({ id, levels }) => [id, levels.map((one) => one.weight)]));
    this.place(rootMatrix(manifest.frame));
    this.scene.add(this.spark, this.root);
    this.setColors(colorsOf(manifest));
    // in advance, in a fixed order: splats of equal depth are drawn in the order of their meshes
    for (const { id } of manifest.labels) this.#column(id);
  }

  /** Whether the last frame was complete, and sorted for the camera's position. */
  get settled(): boolean {
    const { sorting, sortDirty, display, current } = this.spark;
    return !sorting && !sortDirty && display === current;
  }

  /** Sets the similarity from the bundle's frame to the scene. */
  place(matrix: Matrix4): void {
    matrix.decompose(this.root.position, this.root.quaternion, this.root.scale);
  }

  /** Colours (#rrggbb) by label. */
  setColors(colors: ReadonlyMap<number, string>): void {
    for (const [id, color] of colors) {
      this.#colors.set(id, color);
      const column = this.#columns.get(id);
      if (column) column.color.value = rgbOf(color);
    }
  }

  async decode(
    label: number,
    level: number,
    bytes: Uint8Array,
    format: Format,
    below: readonly Uint8Array[] = [],
  ): Promise<Increment> {
    const part =
      format === "stream"
        ? await this.#decoders.decode(label, [...below, bytes])
        : await decodePart(bytes, format);
    return { label, level, count: part.count, part };
  }

  swap(show: readonly Handle[], hide: readonly Handle[]): void {
    const labels = new Set([...show, ...hide].map((handle) => handle.label));
    for (const label of labels) {
      const column = this.#column(label);
      const kept = column.shown.filter((part) => !hide.includes(part) && !show.includes(part));
      const added = show.filter((handle): handle is Increment => handle.label === label);
      column.shown = [...kept, ...added].sort((a, b) => a.level - b.level);
      this.#arrange(column);
    }
    this.#dirty();
  }

  dispose(handle: Handle): void {
    const column = this.#columns.get(handle.label);
    if (!column) return;
    column.shown = column.shown.filter((part) => part !== handle);
    if (column.stored.some((part) => part === handle)) this.#store(column);
    this.#dirty();
  }

  /** Shows or hides a label without releasing its content. */
  setVisible(label: number, visible: boolean): void {
    this.#column(label).mesh.visible = visible;
    this.#dirty();
  }

  /** The shown splats of a label, in the order of its levels. */
  splatsOf(label: number): Packed | null {
    const column = this.#columns.get(label);
    const words = column?.source.splats.packedArray;
    if (!column || !words || !column.mesh.visible) return null;
    const { marks, source } = column;
    return {
      label,
      words,
      count: source.count,
      ...(marks && { hidden: marks.map((m) => +(m === Mark.hidden)) }),
    };
  }

  /** The words of the splats of a label in their own colours. */
  plainWords(label: number): Uint32Array | null {
    const column = this.#columns.get(label);
    if (!column?.stored.length) return null;
    const words = new Uint32Array(4 * total(column.stored));
    let start = 0;
    for (const { part } of column.stored) {
      words.set(part.splats, 4 * start);
      start += part.count;
    }
    return words;
  }

  /** The encoding of the words of `splatsOf`. */
  encodingOf(label: number): Encoding {
    return this.#columns.get(label)?.stored[0]?.part.encoding ?? ENCODING;
  }

  /** Lights or hides splats of a label, by rank; null: all are as they come. */
  setMarks(label: number, marks: Uint8Array | null): void {
    const column = this.#column(label);
    if (column.marks === marks) return;
    column.marks = marks;
    this.#store(column);
    this.#dirty();
  }

  /** Sets the share of the label colours that is mixed in, 0 to 1. */
  setTint(amount: number): void {
    this.#tint.value = amount;
    for (const { mesh } of this.#columns.values()) mesh.updateVersion();
    this.#dirty();
  }

  /** Frees all GPU memory. The layer draws nothing afterwards. */
  free(): void {
    for (const { mesh, source } of this.#columns.values()) {
      this.root.remove(mesh);
      source.dispose();
    }
    this.#columns.clear();
    this.#decoders.close();
    this.spark.dispose();
  }

  #column(label: number): Column {
    const known = this.#columns.get(label);
    if (known) return known;
    const color = new dyno.DynoVec3({ value: rgbOf(this.#colors.get(label) ?? "#8a8f98") });
    const source = new Source(joined([]));
    const mesh = new SplatMesh({ splats: source, worldModifier: tinted(color, this.#tint) });
    mesh.raycastable = false;
    this.root.add(mesh);
    const column = { mesh, source, color, shown: [], stored: [], weight: 0, marks: null };
    this.#columns.set(label, column);
    return column;
  }

  #arrange(column: Column): void {
    const { shown, stored, source, mesh } = column;
    if (!shown.every((part, i) => part === stored[i])) {
      this.#store(column);
      return;
    }
    source.count = total(shown);
    if (!shown.length || this.#weight(column) === column.weight) return;
    if (column.marks) {
      this.#store(column);
      return;
    }
    // the previous image stays until one of the new opacities is made
    const words = source.splats.packedArray;
    if (words) this.#blend(column, words);
    source.splats.needsUpdate = true;
    mesh.updateVersion();
  }

  #store(column: Column): void {
    const { mesh, source, shown } = column;
    source.dispose();
    column.stored = shown;
    source.splats = joined(
      shown.map((increment) => increment.part),
      (words) => this.#blend(column, words),
    );
    source.count = total(shown);
    mesh.updateGenerator();
    mesh.updateMappingVersion(); // the previous image stays until the new one is sorted
  }

  /** Weight of the second opacities at the level that is shown. */
  #weight({ shown }: Column): number {
    const newest = shown.at(-1);
    return (newest && this.#weights.get(newest.label)?.[newest.level - 1]) ?? 0;
  }

  /** Sets the opacities of what is stored. */
  #blend(column: Column, words: Uint32Array): void {
    column.weight = this.#weight(column);
    blendOpacities(
      words,
      column.stored.map(({ part }) => part),
      column.weight,
    );
    if (column.marks) applyMarks(words, column.marks, total(column.stored));
  }
}

/** Changes the colours of lit splats and the opacities of hidden ones. */
function applyMarks(words: Uint32Array, marks: Uint8Array, count: number): void {
  for (let i = 0, at = 0; i < Math.min(count, marks.length); i++, at += 4) {
    const word = words[at] as number;
    if (marks[i] === Mark.hidden) words[at] = word & 0xffffff;
    else if (marks[i] === Mark.lit) words[at] = lit(word);
  }
}

function lit(word: number): number {
  let mixed = word & 0xff000000;
  LIT.forEach((value, i) => {
    // the highlight's own 0 to 255 is less than the range of packed colours
    const packed = 51 + 0.4 * value;
    const own = (word >>> (8 * i)) & 255;
    mixed |= Math.round(own + (packed - own) * LIT_SHARE) << (8 * i);
  });
  return mixed >>> 0;
}

function startWorker(answered: (answer: Answer) => void, failed: () => void): Worker {
  const worker = new StreamWorker();
  worker.onmessage = ({ data }) => answered(data);
  worker.onerror = failed;
  return worker;
}

const total = (parts: readonly Handle[]) => parts.reduce((sum, part) => sum + part.count, 0);

/** The label colours by id. */
export const colorsOf = ({ labels }: Manifest): Map<number, string> =>
  new Map(labels.map(({ id, color }) => [id, color]));

const rgbOf = (color: string): Vector3 => {
  const [r = 0, g = 0, b = 0] = [1, 3, 5].map((at) => Number.parseInt(color.slice(at, at + 2), 16) / 255);
  return new Vector3(r, g, b);
};

/** Mixes in a label's colour at the brightness of the scene. */
function tinted(color: Color, amount: InstanceType<typeof dyno.DynoFloat>) {
  const vec3 = (x: number, y: number, z: number) => dyno.dynoConst("vec3", [x, y, z]);
  return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
    if (!gsplat) throw new Error("a modifier without input");
    const { rgb } = dyno.splitGsplat(gsplat).outputs;
    const light = dyno.add(dyno.dynoConst("float", 0.45), dyno.dot(rgb, vec3(0.25, 0.55, 0.2)));
    const mixed = dyno.mix(rgb, dyno.mul(color, light), amount);
    return { gsplat: dyno.combineGsplat({ gsplat, rgb: mixed }) };
  });
}
