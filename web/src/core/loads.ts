/** The requests that are on their way, and the files that they bring. */

import type { File } from "./download";

/** A request: a file, or consecutive ranges of one. */
export interface Load {
  files: readonly File[];
  readonly abort: AbortController;
  got: number; // bytes received
  dropped: boolean;
  readonly isPack: boolean; // of ranges that come otherwise if it fails
  isWhole: boolean; // all ranges of a file come, from its beginning
}

const NEARLY_COMPLETE = 16_384; // remaining bytes below which a download is not aborted
const NEARLY_COMPLETE_WHOLE = 2 ** 22; // the same of a file whose ranges cannot be asked for: the next time it would begin anew

const bytesOf = (files: readonly File[]): number => files.reduce((sum, { bytes }) => sum + bytes, 0);

export class Loads {
  private readonly byKey = new Map<string, Load>(); // of files that are not here yet, by key

  get all(): Set<Load> {
    return new Set(this.byKey.values());
  }

  /** Bytes that are still to come. */
  get left(): number {
    let left = 0;
    for (const load of this.all) left += bytesOf(load.files) - load.got;
    return left;
  }

  has({ key }: File): boolean {
    return this.byKey.has(key);
  }

  begin(files: readonly File[], isPack = false): Load {
    const load: Load = {
      files,
      abort: new AbortController(),
      got: 0,
      dropped: false,
      isPack,
      isWhole: false,
    };
    this.claim(load, files);
    return load;
  }

  /** Files that no other request brings are this one's. */
  claim(load: Load, files: readonly File[]): void {
    for (const { key } of files) if (!this.byKey.has(key)) this.byKey.set(key, load);
  }

  brings(load: Load, { key }: File): boolean {
    return this.byKey.get(key) === load;
  }

  /** Takes note that a file of a request has come; whether the request was to bring it. */
  came(load: Load, file: File): boolean {
    return this.brings(load, file) && this.byKey.delete(file.key);
  }

  end(load: Load): void {
    for (const [key, one] of this.byKey) if (one === load) this.byKey.delete(key);
  }

  /** Stops a request. */
  drop(load: Load): void {
    load.dropped = true;
    load.abort.abort();
    this.end(load);
  }

  /** Forgets a file that has come otherwise, and its request if it brings nothing else. */
  forget(file: File): void {
    const load = this.byKey.get(file.key);
    if (!load) return;
    if (load.files.some((one) => one.key !== file.key && this.brings(load, one))) this.came(load, file);
    else this.drop(load);
  }

  /** Stops what brings nothing that is wanted, unless it is nearly complete. */
  keepOnly(wanted: ReadonlySet<string>): void {
    for (const load of this.all) {
      const size = bytesOf(load.files);
      if (
        size - load.got <= (load.isWhole ? NEARLY_COMPLETE_WHOLE : NEARLY_COMPLETE) ||
        load.got > 0.8 * size
      )
        continue;
      if (!load.files.some((file) => wanted.has(file.key) && this.brings(load, file))) this.drop(load);
    }
  }
}
