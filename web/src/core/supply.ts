/** Which files are on their way, have come or have failed. It is told what is wanted, best first. */

import { Bandwidth, DamagedError, DownloadError, download, type File, type Link, Shelf } from "./download";

/** A file that did not come. */
export interface Failure {
  readonly message: string;
  readonly lasting: boolean; // of no use to try again
  readonly tries: number;
  readonly until: number; // ms of the clock, before which it is not tried again
}

interface Load {
  readonly file: File;
  readonly abort: AbortController;
  got: number; // bytes
  dropped: boolean;
}

/** Tries after which a failure is told of; it is still tried again, but seldom. */
export const PATIENCE = 5;
const FIRST_WAIT = 500; // ms, doubled from try to try
const LONGEST_WAIT = 15_000;
const AT_ONCE = 16; // downloads; a browser has no more than 6 on a server without HTTP/2
const AHEAD = 0.25; // seconds of the link's speed to keep in flight: a round trip and some
const UNKNOWN = 32_768; // bytes in flight as long as the speed is not known
const TINY = 16_384; // bytes left that are not worth an abort

export interface SupplyOptions extends Omit<Link, "received"> {
  readonly keepBytes: number; // of files that have come, for when they are wanted again
  readonly changed: () => void; // something came, failed or may be tried again
  readonly atOnce?: number;
}

export class Supply {
  readonly bandwidth: Bandwidth;
  received = 0; // bytes in all
  private readonly loads = new Map<string, Load>();
  private readonly come = new Map<string, Uint8Array>(); // until they are taken
  private readonly failures = new Map<string, Failure>();
  private readonly shelf: Shelf;
  private readonly link: Link;
  private closed = false;

  constructor(private readonly options: SupplyOptions) {
    this.bandwidth = new Bandwidth(options.clock);
    this.shelf = new Shelf(options.keepBytes);
    const received = (bytes: number) => {
      this.received += bytes;
      this.bandwidth.count(bytes);
    };
    this.link = { ...options, received };
  }

  get running(): number {
    return this.loads.size;
  }

  /** Bytes of files kept for later. */
  get keptBytes(): number {
    return this.shelf.bytes;
  }

  isComing(file: File): boolean {
    return this.loads.has(file.sha256);
  }

  isHere(file: File): boolean {
    return this.come.has(file.sha256) || this.shelf.has(file.sha256);
  }

  /** The content, if it is here; it stays on the shelf as long as there is room. */
  take(file: File): Uint8Array | undefined {
    const content = this.come.get(file.sha256) ?? this.shelf.get(file.sha256);
    this.come.delete(file.sha256);
    return content;
  }

  failure(file: File): Failure | undefined {
    return this.failures.get(file.sha256);
  }

  /** Whether a file is not to be tried now. */
  rests(file: File): boolean {
    const failure = this.failures.get(file.sha256);
    return failure !== undefined && (failure.lasting || failure.until > this.link.clock.now());
  }

  /** A file that came in order, but is of no use. */
  spoil(file: File, message: string): void {
    this.failures.set(file.sha256, { message, lasting: true, tries: 1, until: Infinity });
  }

  /** Starts the best of what is wanted, as many as the link can use. */
  fill(wanted: readonly File[]): void {
    for (const file of wanted) {
      if (!this.hasRoom()) return;
      if (!this.loads.has(file.sha256) && !this.rests(file)) void this.run(file);
    }
  }

  /** Aborts what is no longer wanted, unless it is nearly there. */
  keepOnly(wanted: ReadonlySet<string>): void {
    for (const [key, load] of this.loads) {
      const left = load.file.bytes - load.got;
      if (wanted.has(key) || left <= TINY || load.got > 0.8 * load.file.bytes) continue;
      this.drop(key, load);
    }
    for (const key of this.come.keys()) if (!wanted.has(key)) this.come.delete(key);
  }

  /** Forgets failures: all may be tried again at once. */
  forgive(): void {
    this.failures.clear();
  }

  close(): void {
    this.closed = true;
    for (const [key, load] of this.loads) this.drop(key, load);
    this.come.clear();
    this.shelf.clear();
  }

  /** Small files need many requests in flight to fill a link; more than that would only spoil the order. */
  private hasRoom(): boolean {
    if (this.closed || this.loads.size >= (this.options.atOnce ?? AT_ONCE)) return false;
    if (this.loads.size < 2) return true;
    let left = 0;
    for (const load of this.loads.values()) left += load.file.bytes - load.got;
    const { rate } = this.bandwidth;
    return left < (Number.isNaN(rate) ? UNKNOWN : Math.max(AHEAD * rate, UNKNOWN / 2));
  }

  private drop(key: string, load: Load): void {
    load.dropped = true;
    load.abort.abort();
    this.end(key);
  }

  private end(key: string): void {
    this.loads.delete(key);
    if (!this.loads.size) this.bandwidth.running(false);
  }

  private async run(file: File): Promise<void> {
    const key = file.sha256;
    const load: Load = { file, abort: new AbortController(), got: 0, dropped: false };
    if (!this.loads.size) this.bandwidth.running(true);
    this.loads.set(key, load);
    try {
      const again = this.failures.has(key);
      const content = await download(this.link, file, load.abort, again, (got) => {
        load.got = got;
      });
      if (load.dropped) return;
      this.failures.delete(key);
      this.come.set(key, content);
      this.shelf.put(key, content);
    } catch (error) {
      if (load.dropped) return;
      this.fail(file, error);
    }
    this.end(key);
    this.options.changed();
  }

  private fail(file: File, error: unknown): void {
    const { clock } = this.link;
    const tries = (this.failures.get(file.sha256)?.tries ?? 0) + 1;
    const known = error instanceof DownloadError ? error : new DownloadError(`${file.uri}: ${error}`, true);
    const lasting = known.lasting || (known instanceof DamagedError && tries > 1);
    const wait = Math.min(FIRST_WAIT * 2 ** (tries - 1), LONGEST_WAIT);
    this.failures.set(file.sha256, { message: known.message, lasting, tries, until: clock.now() + wait });
    if (!lasting) {
      clock.after(wait, () => {
        if (!this.closed) this.options.changed();
      });
    }
  }
}
