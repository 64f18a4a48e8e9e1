import { dyno, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Group, type Matrix4, Scene, type WebGLRenderer } from "three";
import type { Packed } from "../core/pick";
import type { Box, Format, Handle, Manifest, Renderer, Viewpoint } from "../types";
import { drawInBatches } from "./batches";
import { colorsOf } from "./colors";
import { boundsOf, drawnCells, joinedBounds, touches } from "./culling";
import { type Answer, Decoders, type PaletteBytes } from "./decoding";
import StreamWorker from "./decoding.worker?worker&inline";
import { rootMatrix } from "./frame";
import { blendOpacities, enterEarlier } from "./opacity";
import { ENCODING, type Part } from "./packing";
import { Pool } from "./pool";
import { decodePart } from "./splats";

/** A decoded increment. */
interface Increment extends Handle {
  readonly part: Part;
  readonly bounds: Box | null;
}

/** The increments of a cell. */
interface Column {
  readonly label: number;
  shown: readonly Increment[]; // by level
  bounds: Box | null; // of what is shown
  drawn: boolean; // in sight, or nearly
  since: number; // version of the table in which it came into sight
  weight: number; // of the second opacities
  marks: Uint8Array | null; // by splat, one of `Mark`
}

/** How a splat is drawn while labels are edited. */
export const Mark = { plain: 0, lit: 1, hidden: 2 } as const;
const LIT = [255, 190, 40] as const; // colour that lit splats are mixed with
const LIT_SHARE = 0.65;
const LEVELS = 256; // more than a cell has: the streams of a cell are numbered by their first levels

/** Draws all cells of a scene with Spark; increments can be added and removed without visible gaps. */
export class SparkLayer implements Renderer {
  readonly scene = new Scene();
  readonly root = new Group();
  readonly spark: SparkRenderer;
  readonly #columns = new Map<number, Column>(); // by cell; splats of equal depth are drawn in their order
  readonly #colors = new Map<number, string>(); // by cell
  readonly #hidden = new Set<number>(); // labels
  readonly #weights: ReadonlyMap<number, readonly (number | undefined)[]>; // of second opacities, by cell and level
  readonly #decoders = new Decoders(startWorker, workers());
  readonly #tint = new dyno.DynoFloat({ value: 0 });
  readonly #pool: Pool;
  readonly #mesh: SplatMesh;
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
    this.#pool = new Pool(renderer, this.#tint, () => this.#mesh.updateGenerator());
    this.#mesh = new SplatMesh({
      splats: this.#pool,
      raycastable: false,
      onFrame: () => this.#pool.upload(),
    });
    this.root.add(this.#mesh);
    this.place(rootMatrix(manifest.frame));
    this.scene.add(this.spark, this.root);
    for (const { label, cell } of cells) this.#column(label, cell.id);
    this.setColors(colorsOf(manifest));
  }

  /** Whether the last frame was complete, and sorted for the camera's position. */
  get settled(): boolean {
    const { sorting, sortDirty, display, current } = this.spark;
    return !sorting && !sortDirty && display === current;
  }

  /** Whether all that is shown is in the picture: what has come since is sorted later. */
  get isCurrent(): boolean {
    const { count, version } = this.#sorted;
    return count === this.#pool.getNumSplats() && (!count || version === this.#mesh.mappingVersion);
  }

  /** Splats in the picture, and the version of the table that they are of. */
  get #sorted(): { count: number; version: number } {
    const { count = 0, mappingVersion = 0 } = this.spark.display.mapping[0] ?? {};
    return { count, version: mappingVersion };
  }

  /** Sets the similarity from the bundle's frame to the scene. */
  place(matrix: Matrix4): void {
    matrix.decompose(this.root.position, this.root.quaternion, this.root.scale);
  }

  /** Colours (#rrggbb) by cell. */
  setColors(colors: ReadonlyMap<number, string>): void {
    for (const [cell, color] of colors) this.#colors.set(cell, color);
    this.#draw();
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
    const bounds = boundsOf(part.splats, part.count, ENCODING);
    return { label, cell, level, count: part.count, part, bounds };
  }

  swap(show: readonly Handle[], hide: readonly Handle[]): void {
    const added = show as readonly Increment[];
    this.#pool.add(added.map(({ part }) => part));
    const labels = new Map([...show, ...hide].map(({ cell, label }) => [cell, label]));
    for (const [cell, label] of labels) {
      const column = this.#column(label, cell);
      const own = added.filter((handle) => handle.cell === cell);
      const kept = column.shown.filter((part) => !hide.includes(part) && !own.includes(part));
      column.shown = [...kept, ...own].sort((a, b) => a.level - b.level);
      column.bounds = column.shown.reduce<Box | null>((all, { bounds }) => joinedBounds(all, bounds), null);
      this.#paint(cell, column, own);
    }
    this.#draw();
  }

  dispose(handle: Handle): void {
    const increment = handle as Increment;
    const column = this.#columns.get(handle.cell);
    const isShown = column?.shown.includes(increment) ?? false;
    if (column && isShown) column.shown = column.shown.filter((one) => one !== increment);
    if (this.#pool.remove(increment.part) || isShown) this.#draw();
  }

  /** Leaves out the cells that are far from what a viewpoint sees; to be called before each frame. */
  cull(view: Viewpoint): void {
    const columns = [...this.#columns.values()];
    const drawn = drawnCells(
      columns.map(({ bounds, shown, drawn }) => ({ bounds, count: total(shown), drawn })),
      view,
    );
    const changed = columns.filter((column, i) => column.drawn !== drawn[i]);
    if (!changed.length) return;
    for (const column of changed) column.drawn = !column.drawn;
    this.#draw();
    for (const column of changed) column.since = this.#mesh.mappingVersion;
  }

  /** Whether a cell that was left out is in this view, and the picture with it is not sorted yet. */
  misses(view: Viewpoint): boolean {
    const { version } = this.#sorted;
    return [...this.#columns.values()].some((column) => {
      const { bounds, since } = column;
      return since > version && this.#isDrawn(column) && bounds && touches(bounds, view.frustum);
    });
  }

  /** Shows or hides a label without releasing its content. */
  setVisible(label: number, visible: boolean): void {
    if (visible) this.#hidden.delete(label);
    else this.#hidden.add(label);
    this.#draw();
  }

  /** The shown splats of a cell, in the order of its levels. */
  splatsOf(cell: number): Packed | null {
    const column = this.#columns.get(cell);
    if (!column || this.#hidden.has(column.label)) return null;
    const { marks, label, shown } = column;
    return {
      label,
      words: joined(shown, (part) => this.#pool.wordsOf(part)),
      count: total(shown),
      ...(shown[0] && { level: shown[0].level }),
      ...(marks && { hidden: marks.map((m) => +(m === Mark.hidden)) }),
    };
  }

  /** The words of the splats of a cell in their own colours. */
  plainWords(cell: number): Uint32Array | null {
    const shown = this.#columns.get(cell)?.shown ?? [];
    return shown.length ? joined(shown, (part) => part.splats) : null;
  }

  /** Lights or hides splats of a cell, by rank; null: all are as they come. */
  setMarks(cell: number, marks: Uint8Array | null): void {
    const column = this.#columns.get(cell);
    if (!column || column.marks === marks) return;
    column.marks = marks;
    this.#paint(cell, column, column.shown);
    this.#draw();
  }

  /** Sets the share of the label colours that is mixed in, 0 to 1. */
  setTint(amount: number): void {
    this.#tint.value = amount;
    this.#mesh.updateVersion();
    this.#dirty();
  }

  /** Frees all GPU memory. The layer draws nothing afterwards. */
  free(): void {
    this.root.remove(this.#mesh);
    this.#pool.dispose();
    this.#decoders.close();
    this.spark.sortDirty = false; // no other sort begins, and one that has begun needs what is freed here
    const end = () => (this.spark.sorting ? setTimeout(end, 50) : this.spark.dispose());
    end();
  }

  #column(label: number, cell: number): Column {
    const known = this.#columns.get(cell);
    if (known) return known;
    const column = { label, shown: [], bounds: null, drawn: true, since: 0, weight: 0, marks: null };
    this.#columns.set(cell, column);
    return column;
  }

  #isDrawn({ drawn, label }: Column): boolean {
    return drawn && !this.#hidden.has(label);
  }

  /** Draws what is shown and in sight; the previous picture stays until this is sorted. */
  #draw(): void {
    const increments = [...this.#columns.values()].flatMap((column) =>
      this.#isDrawn(column) ? column.shown : [],
    );
    this.#pool.draw(increments.map(({ cell, part }) => ({ part, color: rgbOf(this.#colors.get(cell)) })));
    this.#mesh.updateMappingVersion();
    this.#dirty();
  }

  /** Sets the opacities and marks of what has come into a cell, and of all where they are others now. */
  #paint(cell: number, column: Column, added: readonly Increment[]): void {
    const { shown, marks } = column;
    const weight = this.#weights.get(cell)?.[(shown.at(-1)?.level ?? 0) - 1] ?? 0;
    const hasEarlier = added.some(({ part }) => part.earlier);
    if (hasEarlier) enterEarlier(shown.map(({ part }) => part));
    const isOther = hasEarlier || marks || weight !== column.weight;
    column.weight = weight;
    let start = 0;
    for (const increment of shown) {
      const { part } = increment;
      const first = start;
      start += part.count;
      if (!isOther && !added.includes(increment)) continue;
      this.#pool.write(part, (words) => {
        blendOpacities(words, part, weight);
        if (marks) applyMarks(words, marks.subarray(first, start));
      });
    }
  }
}

/** Changes the colours of lit splats and the opacities of hidden ones. */
function applyMarks(words: Uint32Array, marks: Uint8Array): void {
  for (let i = 0, at = 0; i < marks.length; i++, at += 4) {
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

/** 0xrrggbb of #rrggbb. */
const rgbOf = (color = "#8a8f98"): number => Number.parseInt(color.slice(1), 16);

const total = (increments: readonly Handle[]) => increments.reduce((sum, { count }) => sum + count, 0);

/** The words of increments, one after the other. */
function joined(increments: readonly Increment[], wordsOf: (part: Part) => Uint32Array): Uint32Array {
  const words = new Uint32Array(4 * total(increments));
  let start = 0;
  for (const { part } of increments) {
    words.set(wordsOf(part), 4 * start);
    start += part.count;
  }
  return words;
}
