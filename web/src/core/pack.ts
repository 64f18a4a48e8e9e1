/** The pack of a bundle: its increments as one stream, each of use as soon as its last byte is there. */

import type { Manifest } from "../types";
import { DamagedError, DownloadError, type File, type Link, type Reply, receive } from "./download";

/** ms without a byte, after which the files are rather fetched one by one. */
const SILENCE = 3000;

/** The increments in a manifest's pack, in their order. */
export const filesOf = ({ pack, labels }: Manifest): File[] =>
  (pack?.order ?? [])
    .flatMap(([label, level]) => labels[label]?.levels[level - 1] ?? [])
    .filter((file) => file.bytes);

/** Requests that a browser has on their way at once, without HTTP/2. */
const CONNECTIONS = 6;

export class Pack {
  private at = 0; // bytes that have come
  private readonly ends = new Map<string, number>(); // offsets of what has not been handed over
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

  /** Whether a file is in the pack, to come or not. */
  holds(file: File): boolean {
    return this.all.has(file.sha256);
  }

  /** Bytes until a file is whole, 0: it is being checked; NaN: it will not come (any more). */
  until(file: File): number {
    const left = Math.max(0, (this.ends.get(file.sha256) ?? Number.NaN) - this.at);
    return this.stopped && left > 0 ? Number.NaN : left;
  }

  /** Whether all its bytes have come; a browser keeps it only if it is read to its end. */
  get isHere(): boolean {
    return this.at >= this.file.bytes;
  }

  stop(): void {
    this.stopped = true;
    this.abort.abort();
  }

  /**
   * Hands over each file as it comes, to be checked; ends when all of them are. Rejects with a DownloadError, a
   * DamagedError for a pack that is shorter or longer than promised.
   */
  async read(link: Link, take: (file: File, content: Uint8Array) => Promise<void>): Promise<void> {
    const checks: Promise<void>[] = [];
    let part = new Uint8Array(this.files[0]?.bytes ?? 0);
    let filled = 0;
    let next = 0;
    const whole = (file: File, content: Uint8Array) =>
      take(file, content).finally(() => this.ends.delete(file.sha256));
    const add = (piece: Uint8Array): boolean => {
      let used = 0;
      for (let file = this.files[next]; file && used < piece.length; file = this.files[next]) {
        const size = Math.min(piece.length - used, part.length - filled);
        part.set(piece.subarray(used, used + size), filled);
        used += size;
        filled += size;
        if (filled < part.length) break;
        checks.push(whole(file, part));
        next += 1;
        part = new Uint8Array(this.files[next]?.bytes ?? 0);
        filled = 0;
      }
      this.at += piece.length;
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
 * Of files that a pack is to bring those that are here sooner by requests of their own: behind more that nobody
 * wants than round trips for the rest cost, or more than a round trip later than in the order of worth.
 *
 * @param files - in the order of their worth
 * @param trip - bytes that the link carries in a round trip; NaN: not known yet
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
