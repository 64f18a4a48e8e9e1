/** The pack of a bundle: increments in the order of the first view, so that few requests bring them. */

import type { Level, Manifest } from "../types";
import type { File } from "./download";

/** Share of the bytes of a request that nobody has asked for, at most: gaps between what is wanted. */
const GAPS = 0.05;

/** The increments in a manifest's pack, in their order. */
export function filesOf({ pack, labels }: Manifest): Level[] {
  const cells = new Map(labels.flatMap((label) => label.cells.map(({ id, levels }) => [id, levels])));
  return (pack?.order ?? []).flatMap(([id, level]) => cells.get(id)?.[level - 1] ?? []);
}

/** A pack as ranges of a file, each of which a file of its own has as well. */
export class Pack {
  /** In their order. */
  readonly files: readonly File[];
  /** The first levels at its beginning, which every plan wants. */
  readonly beginning: readonly File[];
  private readonly places: ReadonlyMap<string, number>;

  constructor(manifest: Manifest) {
    const { uri = "", order = [] } = manifest.pack ?? {};
    let offset = 0;
    this.files = filesOf(manifest).map(({ bytes, key, sha256 }) => {
      offset += bytes;
      return { uri, offset: offset - bytes, bytes, key, sha256 };
    });
    const higher = order.findIndex(([, level]) => level > 1);
    this.beginning = higher < 0 ? this.files : this.files.slice(0, higher);
    this.places = new Map(this.files.map(({ key }, i) => [key, i]));
  }

  /**
   * The ranges around a file that one request brings: wanted ones, with small gaps between them.
   *
   * @param isWanted - also of the file itself; by key
   * @param room - bytes that will be asked for now
   */
  around({ key }: File, isWanted: (key: string) => boolean, room: number): readonly File[] {
    const place = this.places.get(key);
    if (place === undefined) return [];
    const wants = (i: number) => isWanted(this.files[i]?.key ?? "");
    const sizeOf = (i: number) => this.files[i]?.bytes ?? 0;
    let [start, end, bytes, gaps] = [place, place + 1, sizeOf(place), 0];
    while (start > 0 && wants(start - 1) && bytes < room) bytes += sizeOf(--start);
    for (let i = end; i < this.files.length && bytes < room; i++) {
      bytes += sizeOf(i);
      if (!wants(i)) gaps += sizeOf(i);
      else if (gaps <= GAPS * bytes) end = i + 1;
    }
    return this.files.slice(start, end);
  }
}
