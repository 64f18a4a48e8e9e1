import { dyno, PackedSplats, type SplatMesh } from "@sparkjsdev/spark";
import {
  Data3DTexture,
  DataTexture,
  RGIntegerFormat,
  type Texture,
  UnsignedIntType,
  Vector3,
  type WebGLRenderer,
} from "three";
import { ENCODING, HARMONICS, type Part, WORDS } from "./packing";

const ROW = 2048; // splats per row of Spark's textures, and rows of one of their layers
const TABLE_ROW = 4096;
const SPARE = 1.5; // room in textures, of the splats that are there when they are made
const WASTE = 3; // room in them, of the splats that are there, from which on they are made smaller
const UNPACK = [
  "UNPACK_ROW_LENGTH",
  "UNPACK_IMAGE_HEIGHT",
  "UNPACK_SKIP_PIXELS",
  "UNPACK_SKIP_ROWS",
  "UNPACK_SKIP_IMAGES",
] as const;

type Source = NonNullable<ConstructorParameters<typeof SplatMesh>[0]>["splats"] & object;

/** Splats that are drawn, and the colour (0xrrggbb) that they are tinted with. */
interface Drawn {
  readonly part: Part;
  readonly color: number;
}

/**
 * All splats of a scene in one set of textures, and a table of those that are drawn, in their order. Spark takes
 * a draw, a shader and whole rows of textures for each of its meshes, before every picture; this is one of them.
 */
export class Pool implements Source {
  private splats = new PackedSplats({
    packedArray: new Uint32Array(4 * ROW),
    numSplats: ROW,
    splatEncoding: ENCODING,
  });
  #starts = new Map<Part, number>();
  #end = 0; // of the splats in the textures
  readonly #added = new Set<number>(); // rows whose harmonics are to be uploaded
  readonly #written = new Set<number>(); // rows whose words are
  #count = 0; // drawn ones
  private readonly table = new dyno.DynoUsampler2D({ key: "table", value: tableOf(1) });

  /**
   * @param tint - the share of their colours that is mixed in, 0 to 1
   * @param onMove - called when there are other textures
   */
  constructor(
    private readonly renderer: WebGLRenderer,
    private readonly tint: InstanceType<typeof dyno.DynoFloat>,
    private readonly onMove: () => void,
  ) {
    // three asks the GPU for what it does not know, and the page waits for all that the GPU has to do first
    const gl = renderer.getContext() as WebGL2RenderingContext;
    for (const name of UNPACK) renderer.state.pixelStorei(gl[name], 0);
  }

  /** Makes room for parts, which have to be written before they are drawn. */
  add(parts: readonly Part[]): void {
    const added = parts.filter((part) => !this.#starts.has(part));
    const { extra, maxSplats } = this.splats;
    const isNew = added.some(({ harmonics }) => [...harmonics.keys()].some((key) => !extra[key]));
    if (isNew || this.#end + total(added) > maxSplats) {
      this.#move([...this.#starts.keys(), ...added]);
      return;
    }
    for (const part of added) {
      this.#place(part, part.splats);
      this.#mark(this.#added, part);
    }
  }

  /** Updates the textures; to be called before they are drawn from. */
  upload(): void {
    const { source, packedArray, extra } = this.splats;
    this.#copy(this.#written, packedArray, source);
    for (const key of HARMONICS) {
      const texture = extra[`${key}Texture`] as { value: Texture } | undefined;
      this.#copy(this.#added, extra[key] as Uint32Array, texture?.value);
    }
    this.#written.clear();
    this.#added.clear();
  }

  /** Forgets a part. Whether others have moved, so that what is drawn has to be set anew. */
  remove(part: Part): boolean {
    this.#starts.delete(part);
    const parts = [...this.#starts.keys()];
    const isWasteful = WASTE * Math.max(ROW, total(parts)) < this.splats.maxSplats;
    if (isWasteful) this.#move(parts);
    return isWasteful;
  }

  /** Writes the words that a part is drawn with: those it came with, changed by `change`. */
  write(part: Part, change: (words: Uint32Array) => void): void {
    const words = this.wordsOf(part);
    words.set(part.splats);
    change(words);
    this.#mark(this.#written, part);
  }

  /** The words that a part is drawn with. */
  wordsOf(part: Part): Uint32Array {
    const start = 4 * (this.#starts.get(part) as number);
    return (this.splats.packedArray as Uint32Array).subarray(start, start + 4 * part.count);
  }

  /** Sets what is drawn. */
  draw(all: readonly Drawn[]): void {
    this.#count = total(all.map(({ part }) => part));
    const rows = Math.ceil(this.#count / TABLE_ROW);
    if (rows > this.table.value.image.height) {
      this.table.value.dispose();
      this.table.value = tableOf(Math.ceil(SPARE * rows));
    }
    const words = this.table.value.image.data as Uint32Array;
    let at = 0;
    for (const { part, color } of all) {
      const start = this.#starts.get(part) as number;
      for (let i = start; i < start + part.count; i++) {
        words[at++] = i;
        words[at++] = color;
      }
    }
    this.table.value.needsUpdate = true;
  }

  fetchSplat: Source["fetchSplat"] = ({ index, viewOrigin }) => {
    const { place, color } = new dyno.Dyno({
      inTypes: { table: "usampler2D", index: "int" },
      outTypes: { place: "int", color: "vec3" },
      inputs: { table: this.table, index },
      statements: ({ inputs: { table, index }, outputs: { place, color } }) =>
        dyno.unindentLines(`
          uvec2 entry = texelFetch(${table}, ivec2(${index} % ${TABLE_ROW}, ${index} / ${TABLE_ROW}), 0).xy;
          ${place} = int(entry.x);
          ${color} = vec3(uvec3(entry.y >> 16u, entry.y >> 8u, entry.y) & 255u) / 255.0;`),
    }).outputs;
    const at = viewOrigin ? { index: place, viewOrigin } : { index: place };
    return tinted(this.splats.fetchSplat(at), color, this.tint);
  };

  prepareFetchSplat(): void {}
  forEachSplat(): void {}
  getNumSplats = () => this.#count;
  hasRgbDir = () => this.splats.hasRgbDir();
  getNumSh = () => this.splats.getNumSh();
  setMaxSh = (degree: number) => this.splats.setMaxSh(degree);

  dispose(): void {
    this.splats.dispose();
    this.table.value.dispose();
  }

  /** Copies parts to textures that are large enough. */
  #move(parts: readonly Part[]): void {
    const known = new Map(
      parts.map((part) => [part, this.#starts.has(part) ? this.wordsOf(part) : part.splats]),
    );
    const before = this.splats;
    const numSplats = roomFor(SPARE * total(parts));
    const keys = HARMONICS.filter((key) => parts.some(({ harmonics }) => harmonics.has(key)));
    this.splats = new PackedSplats({
      packedArray: new Uint32Array(4 * numSplats),
      numSplats,
      extra: Object.fromEntries(keys.map((key) => [key, new Uint32Array(WORDS[key] * numSplats)])),
      splatEncoding: ENCODING,
    });
    this.#starts = new Map();
    this.#end = 0;
    this.#added.clear();
    this.#written.clear();
    for (const [part, words] of known) this.#place(part, words);
    before.dispose();
    this.onMove();
  }

  #place(part: Part, words: Uint32Array): void {
    const { packedArray, extra } = this.splats;
    packedArray?.set(words, 4 * this.#end);
    for (const [key, values] of part.harmonics) {
      (extra[key] as Uint32Array).set(values, WORDS[key] * this.#end);
    }
    this.#starts.set(part, this.#end);
    this.#end += part.count;
  }

  #mark(rows: Set<number>, part: Part): void {
    const start = this.#starts.get(part) as number;
    for (let row = Math.floor(start / ROW); row * ROW < start + part.count; row++) rows.add(row);
  }

  #copy(rows: ReadonlySet<number>, words: Uint32Array | null, texture?: Texture | null): void {
    if (!texture || !words) return;
    const size = (words.length / this.splats.maxSplats) * ROW;
    for (const [row, end] of runsOf(rows)) {
      const some = new Data3DTexture(words.subarray(row * size, end * size), ROW, end - row, 1);
      const at = new Vector3(0, row % ROW, Math.floor(row / ROW));
      this.renderer.copyTextureToTexture(some, texture, null, at);
    }
  }
}

/** The first rows and ends of rows that follow each other in a layer. */
function runsOf(rows: ReadonlySet<number>): [number, number][] {
  const runs: [number, number][] = [];
  for (const row of [...rows].sort((a, b) => a - b)) {
    const last = runs.at(-1);
    if (last?.[1] === row && row % ROW) last[1]++;
    else runs.push([row, row + 1]);
  }
  return runs;
}

/** How many splats textures of Spark have place for, that are large enough for this many: full rows and layers. */
function roomFor(count: number): number {
  const rows = Math.max(1, Math.ceil(count / ROW));
  return ROW * (rows <= ROW ? rows : Math.ceil(rows / ROW) * ROW);
}

/** A texture of pairs: the place of a splat and its colour. */
function tableOf(rows: number): DataTexture {
  const words = new Uint32Array(2 * TABLE_ROW * rows);
  const texture = new DataTexture(words, TABLE_ROW, rows, RGIntegerFormat, UnsignedIntType);
  texture.internalFormat = "RG32UI";
  texture.needsUpdate = true;
  return texture;
}

const total = (parts: readonly Part[]) => parts.reduce((sum, { count }) => sum + count, 0);

type Splat = ReturnType<Source["fetchSplat"]>;

/** Mixes in a colour at the brightness of the scene. */
function tinted(gsplat: Splat, color: dyno.DynoVal<"vec3">, amount: dyno.DynoVal<"float">): Splat {
  const { rgb } = dyno.splitGsplat(gsplat).outputs;
  const weights = dyno.dynoConst("vec3", [0.25, 0.55, 0.2]);
  const light = dyno.add(dyno.dynoConst("float", 0.45), dyno.dot(rgb, weights));
  return dyno.combineGsplat({ gsplat, rgb: dyno.mix(rgb, dyno.mul(color, light), amount) });
}
