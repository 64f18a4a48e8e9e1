/** Schedules the downloads of the wanted files, best first; knows what has arrived or failed. */

import {
  Bandwidth,
  DamagedError,
  DownloadError,
  download,
  type File,
  intact,
  type Link,
  Shelf,
} from "./download";
import { lateIn, Pack } from "./pack";

/** A failed download. */
export interface Failure {
  readonly message: string;
  readonly lasting: boolean; // a retry is useless
  readonly tries: number;
  readonly until: number; // ms of the clock: earliest time of a retry
}

interface Load {
  readonly file: File;
  readonly abort: AbortController;
  got: number; // bytes received
  dropped: boolean;
}

/** Tries after which a failure is shown to the user; it is still retried, but rarely. */
export const PATIENCE = 5;
const FIRST_WAIT = 500; // ms, doubled with each try
const LONGEST_WAIT = 15_000;
const AT_ONCE = 16; // concurrent downloads; browsers allow only 6 without HTTP/2
const AHEAD = 0.25; // seconds of bandwidth to keep in flight: more than a round trip
const UNKNOWN = 32_768; // bytes in flight while the bandwidth is unknown
const TINY = 16_384; // remaining bytes below which a download is not aborted

export interface SupplyOptions extends Omit<Link, "received" | "answered"> {
  readonly keepBytes: number; // cache of downloaded files
  readonly changed: () => void; // called when a file arrived, failed or may be retried
  readonly atOnce?: number;
}

export class Supply {
  readonly bandwidth: Bandwidth;
  received = 0; // bytes in all
  /** Why the pack is unusable, if it does not match the manifest. */
  note: string | null = null;
  private pack: Pack | null = null;
  private damaged = 0; // damaged files of the pack
  private roundTrip = Infinity; // ms
  private readonly unverified = new Set<string>(); // files of a pack whose hash could not be checked
  private readonly loads = new Map<string, Load>();
  private readonly come = new Map<string, Uint8Array>(); // arrived files, until they are taken
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
    const answered = (ms: number) => {
      this.roundTrip = Math.min(ms, 1.25 * this.roundTrip); // waiting in the browser's queue does not count
    };
    this.link = { ...options, received, answered };
  }

  get running(): number {
    return this.loads.size + (this.pack ? 1 : 0);
  }

  /** Whether a pack is loading. */
  get streams(): boolean {
    return this.pack !== null;
  }

  /** Starts loading a pack; files that it brings in time are not downloaded separately. */
  open(file: File, files: readonly File[]): void {
    this.begin();
    this.pack = new Pack(file, files);
    void this.receive(this.pack);
  }

  /** Bytes of cached files. */
  get keptBytes(): number {
    return this.shelf.bytes;
  }

  isComing(file: File): boolean {
    return this.loads.has(file.sha256);
  }

  isHere(file: File): boolean {
    return this.come.has(file.sha256) || this.shelf.has(file.sha256);
  }

  /** Arrived files that were not taken, with their rank in the order of arrival. */
  get waiting(): Map<string, number> {
    return new Map([...this.come.keys()].map((key, i) => [key, i]));
  }

  /** The content, if it has arrived; it stays in the cache while there is room. */
  take(file: File): Uint8Array | undefined {
    const content = this.come.get(file.sha256) ?? this.shelf.get(file.sha256);
    this.come.delete(file.sha256);
    return content;
  }

  failure(file: File): Failure | undefined {
    return this.failures.get(file.sha256);
  }

  /** Whether a file must not be retried yet. */
  rests(file: File): boolean {
    const failure = this.failures.get(file.sha256);
    return failure !== undefined && (failure.lasting || failure.until > this.link.clock.now());
  }

  /** Reports a file that arrived intact but is unusable. */
  spoil(file: File, message: string): void {
    if (this.unverified.delete(file.sha256)) {
      this.shelf.drop(file.sha256);
      this.fail(file, new DamagedError(message, false));
      return;
    }
    this.failures.set(file.sha256, { message, lasting: true, tries: 1, until: Infinity });
  }

  /**
   * Starts the best of the wanted downloads, as many as the link can use; stops the pack when it is useless.
   *
   * @param undecided - more files may be wanted soon, and values are still estimates
   */
  fill(wanted: readonly File[], undecided = false): void {
    const single = this.pack ? this.besides(this.pack, wanted, undecided) : wanted;
    for (const file of single) {
      if (!this.hasRoom()) return;
      if (!this.loads.has(file.sha256) && !this.rests(file)) void this.run(file);
    }
  }

  /** The wanted files that the pack does not bring, or brings late. */
  private besides(pack: Pack, wanted: readonly File[], undecided: boolean): File[] {
    const brought = wanted.filter((file) => !this.loads.has(file.sha256) && pack.until(file) >= 0);
    const late = undecided ? new Set() : lateIn(pack, brought, (this.roundTrip * this.bandwidth.rate) / 1000);
    let brings = false;
    const single = wanted.filter((file) => {
      const mine = pack.until(file) >= 0 && !this.loads.has(file.sha256) && !late.has(file);
      brings ||= mine;
      return !mine && (!brings || pack.holds(file)); // other files wait for those of larger value
    });
    if (!brings && !undecided && !pack.isHere) pack.stop();
    return single;
  }

  /** Aborts downloads that are no longer wanted, unless they are nearly complete. */
  keepOnly(wanted: ReadonlySet<string>): void {
    for (const [key, load] of this.loads) {
      const left = load.file.bytes - load.got;
      if (wanted.has(key) || left <= TINY || load.got > 0.8 * load.file.bytes) continue;
      this.drop(key, load);
    }
    for (const key of this.come.keys()) if (!wanted.has(key)) this.come.delete(key);
  }

  /** Forgets failures, so that all files may be retried immediately. */
  forgive(): void {
    this.failures.clear();
  }

  close(): void {
    this.closed = true;
    this.pack?.stop();
    for (const [key, load] of this.loads) this.drop(key, load);
    this.come.clear();
    this.shelf.clear();
  }

  /** Number of concurrent downloads: many for small files, to fill the link; more would only weaken the order. */
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

  private begin(): void {
    if (!this.running) this.bandwidth.running(true);
  }

  private end(key: string): void {
    this.loads.delete(key);
    if (!this.running) this.bandwidth.running(false);
  }

  private async receive(pack: Pack): Promise<void> {
    try {
      await pack.read(this.link, (file, content) => this.accept(file, content));
    } catch (error) {
      if (error instanceof DamagedError) this.note = `${error.message}; files are loaded one by one.`;
    }
    this.pack = null;
    if (!this.running) this.bandwidth.running(false);
    if (!this.closed) this.options.changed();
  }

  /** Verifies a file of the pack; a damaged one is downloaded again separately. */
  private async accept(file: File, content: Uint8Array): Promise<void> {
    if (this.closed || this.isHere(file)) return;
    try {
      await intact(this.link, file, content);
      if (this.closed) return;
      if (!this.link.digest) this.unverified.add(file.sha256);
      const load = this.loads.get(file.sha256);
      if (load) this.drop(file.sha256, load);
      this.arrive(file, content);
    } catch (error) {
      this.damaged += 1;
      if (this.damaged > 1) this.pack?.stop(); // the rest is likely damaged too
      this.fail(file, error);
    }
    this.options.changed();
  }

  private arrive(file: File, content: Uint8Array): void {
    this.failures.delete(file.sha256);
    this.come.set(file.sha256, content);
    this.shelf.put(file.sha256, content);
  }

  private async run(file: File): Promise<void> {
    const key = file.sha256;
    const load: Load = { file, abort: new AbortController(), got: 0, dropped: false };
    this.begin();
    this.loads.set(key, load);
    try {
      const again = this.failures.has(key);
      const content = await download(this.link, file, load.abort, again, (got) => {
        load.got = got;
      });
      if (load.dropped) return;
      this.unverified.delete(key);
      this.arrive(file, content);
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
