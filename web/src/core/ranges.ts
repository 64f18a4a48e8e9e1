/** Levels that are ranges of a file: which of them one request asks for, and what comes of it. */

import { DamagedError, type File, intact, type Link, type Range, type Reply, receive } from "./download";

/** The ranges among some files, by the file that they are of, in their order. */
export function rangesOf(files: readonly File[]): Map<string, File[]> {
  const ranges = new Map<string, File[]>();
  for (const file of files) {
    if (file.offset === undefined) continue;
    const known = ranges.get(file.uri);
    if (known) known.push(file);
    else ranges.set(file.uri, [file]);
  }
  for (const files of ranges.values()) files.sort((a, b) => (a.offset ?? 0) - (b.offset ?? 0));
  return ranges;
}

/**
 * A range with those after it that one request brings: what would be asked for next anyway, or few bytes.
 *
 * @param all - the ranges of the file
 * @param missing - what is wanted and not asked for, in the order of value
 * @param room - bytes that will be asked for now
 * @param few - bytes that one request brings at least, if they are wanted
 */
export function consecutive(
  range: File,
  all: readonly File[],
  missing: readonly File[],
  room: number,
  few: number,
): readonly File[] {
  let left = room;
  const soon = new Set(
    missing.filter(({ bytes }) => {
      left -= bytes;
      return left > 0;
    }),
  );
  const wanted = new Set(missing);
  const start = all.indexOf(range);
  let end = start + 1;
  let bytes = range.bytes;
  for (let next = all[end]; next && wanted.has(next); next = all[++end]) {
    bytes += next.bytes;
    if (bytes > few && !soon.has(next)) break;
  }
  return all.slice(start, end);
}

/**
 * Downloads and verifies consecutive ranges of a file, in one request. Rejects with a DownloadError in one
 * line; what was taken before stays valid.
 *
 * @param all - all ranges of the file: a server without ranges sends all of them
 */
export async function downloadRanges(
  link: Link,
  wanted: readonly File[],
  all: readonly File[],
  { abort, again, besides, silence, answered, take, corrupt, progress }: Ranges,
): Promise<void> {
  const [first, last] = [wanted[0] as File, wanted.at(-1) as File];
  const start = first.offset ?? 0;
  const range = { start, end: (last.offset ?? 0) + last.bytes };
  const checks: Promise<void>[] = [];
  const cut = (file: File, content: Uint8Array) => {
    checks.push(intact(link, file, content).then(() => take(file, content), corrupt.bind(null, file)));
  };
  let cutter = new Cutter(wanted, cut);
  let name = `bytes ${start} to ${range.end - 1} of ${first.uri}`;
  const check = (reply: Reply) => {
    answered(reply.status === 206);
    if (reply.status === 206) return checkRange(reply, range, name);
    name = first.uri;
    cutter = new Cutter(all, cut);
  };
  await receive(link, first, abort, { again, besides, check, range, silence }, (part) => {
    cutter.add(part);
    progress(cutter.taken);
    return cutter.taken <= cutter.size;
  });
  await Promise.all(checks);
  if (cutter.taken !== cutter.size) {
    const is = cutter.taken < cutter.size ? `only ${cutter.taken} of` : "more than";
    throw new DamagedError(`${name}: damaged, ${is} ${cutter.size} bytes came`, false);
  }
}

/** What `downloadRanges` does besides. */
export interface Ranges {
  readonly abort: AbortController;
  readonly again: boolean; // bypasses the browser's cache
  readonly besides: boolean; // other ranges of the file are on their way
  readonly silence: number | undefined; // ms without data after which it counts as failed
  readonly answered: (ranges: boolean) => void; // whether only what was asked for comes
  /** Called for every range that is intact, in their order. */
  readonly take: (file: File, content: Uint8Array) => void;
  /** Called for every range that is not. */
  readonly corrupt: (file: File, error: unknown) => void;
  readonly progress: (bytes: number) => void;
}

/** Throws for an answer with another range than the one that was asked for. */
function checkRange({ headers }: Reply, { start, end }: Range, name: string): void {
  const sent = headers.get("Content-Range") ?? "nothing";
  if (!sent.startsWith(`bytes ${start}-${end - 1}/`)) {
    throw new DamagedError(`${name}: the server sent ${sent.slice(0, 60)} instead`, false);
  }
}

/** Cuts what arrives into the files that it consists of. */
export class Cutter {
  taken = 0; // bytes
  readonly size: number; // of all files
  private next = 0;
  private part: Uint8Array;
  private filled = 0;

  /** @param whole - called for every complete file */
  constructor(
    private readonly files: readonly File[],
    private readonly whole: (file: File, content: Uint8Array) => void,
  ) {
    this.size = files.reduce((sum, file) => sum + file.bytes, 0);
    this.part = new Uint8Array(files[0]?.bytes ?? 0);
  }

  add(piece: Uint8Array): void {
    let used = 0;
    for (let file = this.files[this.next]; file && used < piece.length; file = this.files[this.next]) {
      const size = Math.min(piece.length - used, this.part.length - this.filled);
      this.part.set(piece.subarray(used, used + size), this.filled);
      used += size;
      this.filled += size;
      if (this.filled < this.part.length) break;
      this.whole(file, this.part);
      this.next += 1;
      this.part = new Uint8Array(this.files[this.next]?.bytes ?? 0);
      this.filled = 0;
    }
    this.taken += piece.length;
  }
}
