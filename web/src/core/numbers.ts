/** Lists of whole numbers in a document, coded as a stream's columns are. docs/formats.md specifies the bytes. */

import { Reader, Table } from "./rans";
import { BundleError } from "./schema";

/** The lists by name, in the order that they are coded in; true: as differences to the number before. */
const LISTS = {
  views: true,
  photos: true,
  thresholds: true,
  slopes: false,
  rows: true,
  logDistances: true,
  offsets: true,
  terms: false,
  values: true,
  factors: true,
  shares: true,
  corrections: true,
} as const;
const KINDS = 65; // symbols: twice the bits of a number, less 1 of a negative one
const COUNT = 16; // of each symbol of a new table
const BLOCK = 16;
const MOST = 2 ** 22; // numbers of a document

type Name = keyof typeof LISTS;
const isName = (name: string): name is Name => Object.hasOwn(LISTS, name);

/**
 * The document with its lists of numbers instead of their lengths; one without `numbers` as it is. Throws a
 * BundleError if they are damaged.
 */
export function unpacked(document: unknown, file: string): unknown {
  if (typeof document !== "object" || document === null || !("numbers" in document)) return document;
  const lists = new Map<Name, number[][]>();
  let total = 0;
  const walk = (value: unknown, name: string): unknown => {
    if (isName(name) && typeof value === "number") {
      total += value;
      if (!(Number.isInteger(value) && value >= 0 && total <= MOST)) throw new Error("too many numbers");
      const list = new Array<number>(value).fill(0);
      const others = lists.get(name);
      if (others) others.push(list);
      else lists.set(name, [list]);
      return list;
    }
    if (Array.isArray(value)) return value.map((item) => walk(item, name));
    if (typeof value !== "object" || value === null) return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, walk(item, key)]));
  };
  try {
    const { numbers, ...whole } = walk(document, "") as Record<string, unknown>;
    if (total)
      read(
        lists,
        Uint8Array.from(atob(String(numbers)), (byte) => byte.charCodeAt(0)),
      );
    return whole;
  } catch {
    throw new BundleError(`${file}: its numbers are damaged. Make the bundle again with sagesplat bundle.`);
  }
}

function read(lists: ReadonlyMap<Name, readonly number[][]>, bytes: Uint8Array): void {
  const reader = new Reader(bytes);
  for (const [name, isDifferences] of Object.entries(LISTS)) {
    const some = lists.get(name as Name) ?? [];
    const found = decoded(
      reader,
      some.reduce((sum, { length }) => sum + length, 0),
    );
    let at = 0;
    for (const numbers of some) {
      let before = 0;
      for (let i = 0; i < numbers.length; i++) {
        const number = (found[at++] as number) + (isDifferences ? before : 0);
        numbers[i] = number;
        before = number;
      }
    }
  }
  reader.finish();
}

/** Numbers of a new table: their sign and how many bits they have, then those below the highest. */
function decoded(reader: Reader, count: number): Float64Array {
  const table = new Table(1, KINDS, () => COUNT);
  const found = new Float64Array(count);
  const kinds = new Int32Array(BLOCK);
  for (let at = 0; at < count; at += BLOCK) {
    const values = found.subarray(at, at + BLOCK);
    reader.ofRow(table, 0, 0, kinds, values.length);
    for (const i of values.keys()) values[i] = kinds[i] ? 1 : 0;
    const widths = kinds.map((kind) => ((kind + 1) >> 1) - 1);
    reader.bits(widths, values, values.length);
    for (const i of values.keys()) if ((kinds[i] as number) & 1) values[i] = -(values[i] as number);
    table.endBlock();
  }
  return found;
}
