import { dyno, type PackedSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Group, type Matrix4, Scene, Vector3, type WebGLRenderer } from "three";
import type { Encoding, Packed } from "../core/pick";
import type { Box, Format, Handle, Manifest, Renderer, Viewpoint } from "../types";
import { drawInBatches } from "./batches";
import { colorsOf } from "./colors";
import { boundsOf, drawnCells, joinedBounds, touches } from "./culling";
import { type Answer, Decoders, type PaletteBytes } from "./decoding";
import StreamWorker from "./decoding.worker?worker&inline";
import { rootMatrix } from "./frame";
import { blendOpacities } from "./opacity";
import { ENCODING, type Part } from "./packing";
import { decodePart, joined } from "./splats";

type Color = InstanceType<typeof dyno.DynoVec3<Vector3>>;

/** A decoded increment. */
interface Increment extends Handle {
  readonly part: Part;
  readonly bounds: Box | null;
}

/**
 * A cell's increments as one mesh: first the shown ones, by level, then those hidden since. There is one mesh
 * per cell, since Spark pads every mesh to 2048 splats and draws each with its own call.
 */
interface Column {
  readonly label: number;
  readonly mesh: SplatMesh;
  readonly source: Source;
  readonly color: Color;
  shown: readonly Increment[];
  stored: readonly Increment[];
  bounds: Box | null; // of what is shown
  drawn: boolean; // in sight, or nearly
  late: boolean; // drawn again, but not in a picture yet
  weight: number; // of the second opacities in what is stored
  marks: Uint8Array | null; // by splat, one of `Mark`
}

/** How a splat is drawn while labels are edited. */
export const Mark = { plain: 0, lit: 1, hidden: 2 } as const;
const LIT = [255, 190, 40] as const; // colour that lit splats are mixed with
const LIT_SHARE = 0.65;
const LEVELS = 256; // more than a cell has: the streams of a cell are numbered by their first levels

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

/** Draws all cells of a scene with Spark; increments can be added and removed without visible gaps. */
export class SparkLayer implements Renderer {
  readonly scene = new Scene();
  readonly root = new Group();
  readonly spark: SparkRenderer;
  readonly #columns = new Map<number, Column>(); // by cell
  readonly #colors = new Map<number, string>();
  readonly #hidden = new Set<number>(); // labels
  readonly #weights: ReadonlyMap<number, readonly (number | undefined)[]>; // of second opacities, by cell and level
  readonly #decoders = new Decoders(startWorker, workers());
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
      minAlpha: 1 / 255, // a contribution below is none, as in training
      maxStdDev: 3.33, // where an opaque splat's alpha falls below that
      maxPixelRadius: 2048,
      preBlurAmount: manifest.antialiased ? 0 : 0.3,
      blurAmount: manifest.antialiased ? 0.3 : 0,
    });
    drawInBatches(this.spark);
    const cells = manifest.labels.flatMap((label) => label.cells.map((cell) => ({ label: label.id, cell })));
    this.#weights = new Map(cells.map(({ cell }) => [cell.id, cell.levels.map((one) => one.weight)]));
    this.place(rootMatrix(manifest.frame));
    this.scene.add(this.spark, this.root);
    this.setColors(colorsOf(manifest));
    // in advance, in a fixed order: splats of equal depth are drawn in the order of their meshes
    for (const { label, cell } of cells) this.#column(label, cell.id);
  }

  /** Whether the last frame was complete, and sorted for the camera's position. */
  get settled(): boolean {
    const { sorting, sortDirty, display, current } = this.spark;
    return !sorting && !sortDirty && display === current;
  }

  /** Whether all that is shown is in the picture: what has come since is sorted later. */
  get isCurrent(): boolean {
    const sorted = new Map<unknown, number>(
      this.spark.display.mapping.map(({ node, count }) => [node, count]),
    );
    return [...this.#columns.values()].every(
      ({ mesh, source }) => !mesh.visible || source.count === (sorted.get(mesh) ?? 0),
    );
  }

  /** Sets the similarity from the bundle's frame to the scene. */
  place(matrix: Matrix4): void {
    matrix.decompose(this.root.position, this.root.quaternion, this.root.scale);
  }

  /** Colours (#rrggbb) by cell. */
  setColors(colors: ReadonlyMap<number, string>): void {
    for (const [id, color] of colors) {
      this.#colors.set(id, color);
      const column = this.#columns.get(id);
      if (column) column.color.value = rgbOf(color);
    }
  }

  async decode(
    label: number,
    cell: number,
    level: number,
    bytes: Uint8Array,
    format: Format,
    below: readonly Uint8Array[] = [],
    palette?: PaletteBytes,
  ): Promise<Increment> {
    const part =
      format === "stream"
        ? await this.#decoders.decode(cell * LEVELS + level - below.length, [...below, bytes], palette)
        : await decodePart(bytes, format);
    const bounds = boundsOf(part.splats, part.count, part.encoding);
    return { label, cell, level, count: part.count, part, bounds };
  }

  swap(show: readonly Handle[], hide: readonly Handle[]): void {
    const cells = new Map([...show, ...hide].map(({ label, cell }) => [cell, label]));
    for (const [cell, label] of cells) {
      const column = this.#column(label, cell);
      const kept = column.shown.filter((part) => !hide.includes(part) && !show.includes(part));
      const added = show.filter((handle): handle is Increment => handle.cell === cell);
      column.shown = [...kept, ...added].sort((a, b) => a.level - b.level);
      column.bounds = column.shown.reduce<Box | null>((all, { bounds }) => joinedBounds(all, bounds), null);
      this.#arrange(column);
    }
    this.#dirty();
  }

  dispose(handle: Handle): void {
    const column = this.#columns.get(handle.cell);
    if (!column) return;
    column.shown = column.shown.filter((part) => part !== handle);
    if (column.stored.some((part) => part === handle)) this.#store(column);
    this.#dirty();
  }

  /** Leaves out the cells that are far from what a viewpoint sees; to be called before each frame. */
  cull(view: Viewpoint): void {
    const columns = [...this.#columns.values()];
    const drawn = drawnCells(
      columns.map(({ bounds, source, drawn }) => ({ bounds, count: source.count, drawn })),
      view,
    );
    columns.forEach((column, i) => {
      const isDrawn = drawn[i] ?? true;
      if (column.drawn !== isDrawn) column.late = isDrawn;
      column.drawn = isDrawn;
      this.#look(column);
    });
  }

  /** Whether a cell that was left out is in this view, and the picture with it is not sorted yet. */
  misses(view: Viewpoint): boolean {
    const late = [...this.#columns.values()].filter((column) => column.late);
    if (!late.length) return false;
    const here = new Set<unknown>(this.spark.display.mapping.map(({ node }) => node));
    for (const column of late) column.late = !here.has(column.mesh);
    return late.some(({ late, mesh, bounds }) => {
      return late && mesh.visible && bounds && touches(bounds, view.frustum);
    });
  }

  /** Shows or hides a label without releasing its content. */
  setVisible(label: number, visible: boolean): void {
    if (visible) this.#hidden.delete(label);
    else this.#hidden.add(label);
    for (const column of this.#columns.values()) this.#look(column);
    this.#dirty();
  }

  /** The shown splats of a cell, in the order of its levels. */
  splatsOf(cell: number): Packed | null {
    const column = this.#columns.get(cell);
    const words = column?.source.splats.packedArray;
    if (!column || !words || this.#hidden.has(column.label)) return null;
    const { marks, source, label, shown } = column;
    return {
      label,
      words,
      count: source.count,
      ...(shown[0] && { level: shown[0].level }),
      ...(marks && { hidden: marks.map((m) => +(m === Mark.hidden)) }),
    };
  }

  /** The words of the splats of a cell in their own colours. */
  plainWords(cell: number): Uint32Array | null {
    const column = this.#columns.get(cell);
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
  encodingOf(cell: number): Encoding {
    return this.#columns.get(cell)?.stored[0]?.part.encoding ?? ENCODING;
  }

  /** Lights or hides splats of a cell, by rank; null: all are as they come. */
  setMarks(cell: number, marks: Uint8Array | null): void {
    const column = this.#columns.get(cell);
    if (!column || column.marks === marks) return;
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
    this.spark.sortDirty = false; // no other sort begins, and one that has begun needs what is freed here
    const end = () => (this.spark.sorting ? setTimeout(end, 50) : this.spark.dispose());
    end();
  }

  #column(label: number, cell: number): Column {
    const known = this.#columns.get(cell);
    if (known) return known;
    const color = new dyno.DynoVec3({ value: rgbOf(this.#colors.get(cell) ?? "#8a8f98") });
    const source = new Source(joined([]));
    const mesh = new SplatMesh({ splats: source, worldModifier: tinted(color, this.#tint) });
    mesh.raycastable = false;
    this.root.add(mesh);
    const column = {
      label,
      mesh,
      source,
      color,
      shown: [],
      stored: [],
      bounds: null,
      drawn: true,
      late: false,
      weight: 0,
      marks: null,
    };
    this.#columns.set(cell, column);
    return column;
  }

  #look({ mesh, drawn, label }: Column): void {
    mesh.visible = drawn && !this.#hidden.has(label);
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
    return (newest && this.#weights.get(newest.cell)?.[newest.level - 1]) ?? 0;
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

/** How many decode at once: half of the cores, as the page draws meanwhile and others sort. */
const workers = () => Math.max(2, Math.min(navigator.hardwareConcurrency >> 1, 4));

function startWorker(answered: (answers: readonly Answer[]) => void, failed: () => void): Worker {
  const worker = new StreamWorker();
  worker.onmessage = ({ data }) => answered(data);
  worker.onerror = failed;
  return worker;
}

const total = (parts: readonly Handle[]) => parts.reduce((sum, part) => sum + part.count, 0);

const rgbOf = (color: string): Vector3 => {
  const [r = 0, g = 0, b = 0] = [1, 3, 5].map((at) => Number.parseInt(color.slice(at, at + 2), 16) / 255);
  return new Vector3(r, g, b);
};

/** Mixes in a cell's colour at the brightness of the scene. */
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
