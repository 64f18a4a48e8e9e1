/** The pack of a bundle: its increments as one stream, each usable as soon as it is complete. */

import type { Level, Manifest } from "../types";
import { DamagedError, DownloadError, type File, type Link, type Reply, receive } from "./download";
import { Cutter } from "./ranges";

/** ms without data after which the files are downloaded one by one instead. */
const SILENCE = 3000;

/** The increments in a manifest's pack, in their order. */
export function filesOf({ pack, labels }: Manifest): Level[] {
  const cells = new Map(labels.flatMap((label) => label.cells.map(({ id, levels }) => [id, levels])));
  return (pack?.order ?? []).flatMap(([id, level]) => cells.get(id)?.[level - 1] ?? []);
}

/** Concurrent requests of a browser without HTTP/2. */
const CONNECTIONS = 6;

export class Pack {
  private at = 0; // bytes received
  private readonly ends = new Map<string, number>(); // end offsets of the files not yet passed on
  private readonly all: ReadonlySet<string>;
  private readonly abort = new AbortController();
  private stopped = false;

  constructor(
    private readonly file: File,
    private readonly files: readonly File[],
  ) {
    let end = 0;
    for (const { sha256, bytes } of files) {
      end += bytes;
      if (!this.ends.has(sha256)) this.ends.set(sha256, end);
    }
    this.all = new Set(this.ends.keys());
  }

  /** Whether a file is in the pack, received or not. */
  holds(file: File): boolean {
    return this.all.has(file.sha256);
  }

  /** Bytes until a file is complete, 0: being verified; NaN: it will not arrive (any more). */
  until(file: File): number {
    const left = Math.max(0, (this.ends.get(file.sha256) ?? Number.NaN) - this.at);
    return this.stopped && left > 0 ? Number.NaN : left;
  }

  /** Bytes that came without being planned, and those up to the next file that is wanted. */
  spare(isPlanned: (file: File) => boolean, isWanted: (file: File) => boolean): number {
    let [spare, end] = [0, 0];
    for (const file of this.files) {
      end += file.bytes;
      const came = end <= this.at;
      if (!came && isWanted(file)) return spare;
      if (!came || !isPlanned(file)) spare += file.bytes;
    }
    return spare;
  }

  /** Whether it is received completely: the browser caches it only then. */
  get isHere(): boolean {
    return this.at >= this.file.bytes;
  }

  stop(): void {
    this.stopped = true;
    this.abort.abort();
  }

  /**
   * Passes on each file when it is complete, to be verified. Resolves when all are. Rejects with a
   * DownloadError, or a DamagedError for a pack that is shorter or longer than its manifest entry.
   */
  async read(link: Link, take: (file: File, content: Uint8Array) => Promise<void>): Promise<void> {
    const checks: Promise<void>[] = [];
    const cutter = new Cutter(this.files, (file, content) => {
      checks.push(take(file, content).finally(() => this.ends.delete(file.sha256)));
    });
    const add = (piece: Uint8Array): boolean => {
      cutter.add(piece);
      this.at = cutter.taken;
      return this.at <= this.file.bytes && !this.stopped;
    };
    try {
      await receive(
        link,
        this.file,
        this.abort,
        { silence: SILENCE, check: (reply) => this.check(reply) },
        add,
      );
      if (!this.stopped && this.at !== this.file.bytes) throw this.odd(this.at);
    } finally {
      this.stopped = true;
      await Promise.allSettled(checks);
    }
  }

  private check({ body, headers }: Reply): void {
    if (!body) throw new DownloadError(`${this.file.uri}: no stream`, false);
    const length = headers.get("Content-Encoding") ? null : headers.get("Content-Length");
    if (length && Number(length) !== this.file.bytes) throw this.odd(Number(length));
  }

  private odd(size: number): DamagedError {
    const { uri, bytes } = this.file;
    const is = size < bytes ? `only ${size} of` : "more than";
    return new DamagedError(`${uri} is damaged: ${is} ${bytes} bytes`, false);
  }
}

/**
 * Files of the pack that arrive earlier by their own requests: those behind more unwanted bytes than round
 * trips for the rest cost, or more than a round trip later than in the order of value.
 *
 * @param files - in the order of their value
 * @param trip - bytes per round trip of the link; NaN: unknown
 */
export function lateIn(pack: Pack, files: readonly File[], trip: number): Set<File> {
  const late = new Set<File>();
  let before = 0;
  for (const file of files) {
    before += file.bytes;
    if (pack.until(file) - before > trip) late.add(file);
  }
  const coming = files.filter((file) => !late.has(file)).sort((a, b) => pack.until(a) - pack.until(b));
  let useful = 0;
  coming.forEach((file, i) => {
    useful += file.bytes;
    const rounds = Math.ceil((coming.length - i) / CONNECTIONS);
    if (pack.until(file) - useful > rounds * trip) late.add(file);
  });
  return late;
}
