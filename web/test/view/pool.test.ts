import { dyno, type PackedSplats } from "@sparkjsdev/spark";
import type { Data3DTexture, DataArrayTexture, DataTexture, Vector3, WebGLRenderer } from "three";
import { beforeEach, describe, expect, test } from "vitest";
import { HARMONICS, type Part, WORDS } from "../../src/view/packing";
import { Pool } from "../../src/view/pool";

const ROW = 2048;

let seed: number;
const random = (below: number) => {
  seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
  return seed % below;
};
const words = (length: number) => Uint32Array.from({ length }, () => random(2 ** 31));

function partOf(count: number, degree: number): Part {
  const keys = HARMONICS.slice(0, degree);
  const harmonics = new Map(keys.map((key) => [key, words(WORDS[key] * count)]));
  return { count, splats: words(4 * count), harmonics, opacities: null };
}

/** A GPU that has of each texture what was there when it was made, and the rows that were copied since. */
class Gpu {
  readonly known = new Map<DataArrayTexture, Uint32Array>();
  readonly state = { pixelStorei: () => {} };
  getContext = () => ({});
  rows = 0; // copied
  copies = 0;
  copyTextureToTexture(some: Data3DTexture, texture: DataArrayTexture, _: null, { y, z }: Vector3): void {
    const { data, width, height } = some.image as { data: Uint32Array; width: number; height: number };
    const { image } = texture as { image: { data: Uint32Array; height: number; depth: number } };
    const size = data.length / (width * height);
    this.known.get(texture)?.set(data, (z * image.height + y) * ROW * size);
    this.rows += height;
    this.copies++;
  }
}

let gpu: Gpu;
let pool: Pool;
let moves: number;

/** Textures as Spark makes them, with their contents, before a frame. */
function textures(): DataArrayTexture[] {
  pool.upload();
  pool.fetchSplat({ index: dyno.dynoConst("int", 0), viewOrigin: dyno.dynoConst("vec3", [0, 0, 0]) });
  const splats = (pool as unknown as { splats: PackedSplats }).splats;
  const harmonics = HARMONICS.flatMap((key) => splats.extra[`${key}Texture`] ?? []);
  const all = [
    splats.getTexture(),
    ...(harmonics as { value: DataArrayTexture }[]).map(({ value }) => value),
  ];
  for (const texture of all) {
    if (!gpu.known.has(texture)) gpu.known.set(texture, (texture.image.data as Uint32Array).slice());
  }
  return all;
}

/** What the GPU has of a part, by texture, where the table says that it is. */
function drawn(place: number, { count, harmonics }: Part): number[][] {
  return textures().flatMap((texture, i) => {
    const key = HARMONICS[i - 1];
    if (key && !harmonics.has(key)) return [];
    const size = key ? WORDS[key] : 4;
    return [[...(gpu.known.get(texture) as Uint32Array).subarray(place * size, (place + count) * size)]];
  });
}

beforeEach(() => {
  seed = 7;
  gpu = new Gpu();
  moves = 0;
  pool = new Pool(gpu as unknown as WebGLRenderer, new dyno.DynoFloat({ value: 0 }), () => moves++);
});

/** The places of the splats that are drawn, and their colours. */
function table(): [number, number][] {
  const texture = (pool as unknown as { table: { value: DataTexture } }).table.value;
  const data = texture.image.data as unknown as Uint32Array;
  return Array.from({ length: pool.getNumSplats() }, (_, i) => [
    data[2 * i] as number,
    data[2 * i + 1] as number,
  ]);
}

describe("a pool of splats", () => {
  test("has on the GPU what is drawn, in order, whatever came, changed and went", () => {
    const parts: Part[] = [];
    for (let step = 0; step < 25; step++) {
      const added = Array.from({ length: 1 + random(3) }, () => partOf(1 + random(900), random(4)));
      pool.add(added);
      parts.push(...added);
      for (const part of parts.filter((part) => added.includes(part) || random(4) === 0)) {
        const word = random(1000);
        part.splats[0] = word;
        pool.write(part, (own) => own.set([word + 1]));
        expect(pool.wordsOf(part)[0]).toBe(word + 1);
        part.splats[0] = word + 1;
      }
      if (parts.length > 20) for (const part of parts.splice(random(5), 8)) pool.remove(part);
      const shown = parts.filter(() => random(3) > 0);
      pool.draw(shown.map((part) => ({ part, color: part.count })));
      const rows = table();
      let at = 0;
      for (const part of shown) {
        const place = rows[at]?.[0] as number;
        const own = rows.slice(at, at + part.count);
        expect(own).toEqual(Array.from({ length: part.count }, (_, i) => [place + i, part.count]));
        expect(drawn(place, part)).toEqual([part.splats, ...part.harmonics.values()].map((all) => [...all]));
        at += part.count;
      }
      expect(at).toBe(rows.length);
    }
    expect(moves).toBeLessThan(12);
  });

  test("copies no more than the rows of a part that comes", () => {
    pool.add([partOf(3 * ROW, 1)]); // room for half as many more
    pool.add([partOf(100, 1)]);
    textures();
    const before = moves;
    const part = partOf(ROW, 1);
    pool.add([part]);
    pool.write(part, () => {});
    textures();
    expect([moves - before, gpu.rows, gpu.copies]).toEqual([0, 4, 2]); // two rows in each of two textures
  });

  test("gives memory back", () => {
    const parts = Array.from({ length: 20 }, () => partOf(ROW, 0));
    pool.add(parts);
    const size = () => textures().reduce((sum, { image }) => sum + (image.data as Uint32Array).length, 0);
    expect(size()).toBe(30 * 4 * ROW);
    for (const part of parts.slice(1)) pool.remove(part);
    expect(size()).toBeLessThanOrEqual(3 * 4 * ROW);
  });

  test("splats without harmonics have none beside others that have", () => {
    const [plain, other] = [partOf(10, 0), partOf(10, 2)];
    pool.add([plain]);
    pool.add([other]);
    pool.draw([{ part: plain, color: 1 }]);
    const place = table()[0]?.[0] as number;
    const [, ...harmonics] = textures();
    expect(harmonics).toHaveLength(2);
    for (const texture of harmonics) {
      const size = texture === harmonics[0] ? WORDS.sh1 : WORDS.sh2;
      const own = (texture.image.data as Uint32Array).subarray(place * size, (place + 10) * size);
      expect([...own]).toEqual(Array(10 * size).fill(0));
    }
  });
});
