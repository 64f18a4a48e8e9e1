/** Schedules the downloads of the wanted files, best first; knows what has arrived or failed. */

import { Bandwidth } from "./bandwidth";
import { LruCache } from "./cache";
import { DamagedError, DownloadError, download, type File, type Link } from "./download";
import { type Load, Loads } from "./loads";
import type { Pack } from "./pack";
import { consecutive, downloadRanges, rangesOf } from "./ranges";

/** A failed download. */
export interface Failure {
  readonly message: string;
  readonly lasting: boolean; // a retry is useless
  readonly tries: number;
  readonly until: number; // ms of the clock: earliest time of a retry
}

/** Tries after which a failure is shown to the user; it is still retried, but rarely. */
export const TRIES_BEFORE_NOTICE = 5;
const FIRST_WAIT = 500; // ms, doubled with each try
const LONGEST_WAIT = 15_000;
const MAX_DOWNLOADS = 16; // concurrent downloads; browsers allow only 6 without HTTP/2
const SECONDS_IN_FLIGHT = 0.25; // seconds of bandwidth to keep in flight: more than a round trip
const BYTES_AT_UNKNOWN_RATE = 32_768; // bytes in flight while the bandwidth is unknown
const REQUESTS_PER_TRIP = 3; // requests that a round trip's bytes are divided between: browsers allow 6
const PACK_SILENCE = 3000; // ms without data after which what the pack brings is asked for otherwise
const LEAST_REQUEST_BYTES = 8192; // bytes of ranges that one request brings at least, if they are wanted

export interface DownloadsOptions extends Omit<Link, "received" | "answered"> {
  readonly keepBytes: number; // cache of downloaded files
  readonly cache?: LruCache | undefined; // instead: of another's, who has the same bundle
  readonly changed: () => void; // called when a file arrived, failed or may be retried
  readonly maxDownloads?: number;
}

export class Downloads {
  readonly bandwidth: Bandwidth;
  received = 0; // bytes in all
  /** Why the pack is unusable, if it does not match the manifest. */
  note: string | null = null;
  private pack: Pack | null = null; // null also once it turned out to be of no use
  private damaged = 0; // damaged files of the pack
  private roundTrip = Infinity; // ms
  private readonly suspects = new Set<string>(); // files that nothing had checked, and that could not be used
  private readonly loads = new Loads();
  private ranges: ReadonlyMap<string, readonly File[]> = new Map(); // of files, by uri
  /** Whether the server answers with ranges; null: it was not asked. */
  sendsRanges: boolean | null = null;
  private readonly arrived = new Map<string, Uint8Array>(); // arrived files, until they are taken
  private readonly failures = new Map<string, Failure>();
  readonly cache: LruCache;
  private readonly link: Link;
  private closed = false;

  constructor(private readonly options: DownloadsOptions) {
    this.bandwidth = new Bandwidth(options.clock);
    this.cache = options.cache ?? new LruCache(options.keepBytes);
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
    return this.loads.all.size;
  }

  /** Names all ranges of files, in their order. */
  setRanges(files: readonly File[]): void {
    this.ranges = rangesOf(files);
  }

  /** Whether anything of a pack is on its way. */
  get hasPack(): boolean {
    return [...this.loads.all].some(({ isPack }) => isPack);
  }

  /** Starts loading the beginning of a pack, and takes from it what one request brings. */
  openPack(pack: Pack): void {
    this.pack = pack;
    if (pack.beginning.some((file) => !this.isHere(file))) void this.run(pack.beginning);
  }

  isHere(file: File): boolean {
    return this.arrived.has(file.key) || this.cache.has(file.key);
  }

  /** Arrived files that were not taken, with their rank in the order of arrival. */
  get arrivals(): Map<string, number> {
    return new Map([...this.arrived.keys()].map((key, i) => [key, i]));
  }

  /** The content, if it has arrived; it stays in the cache while there is room. */
  take(file: File): Uint8Array | undefined {
    const content = this.arrived.get(file.key) ?? this.cache.get(file.key);
    this.arrived.delete(file.key);
    return content;
  }

  failure(file: File): Failure | undefined {
    return this.failures.get(file.key);
  }

  /** Whether a file must not be retried yet. */
  isBackingOff(file: File): boolean {
    const failure = this.failures.get(file.key);
    return failure !== undefined && (failure.lasting || failure.until > this.link.clock.now());
  }

  /** Reports a file that cannot be used. One that nothing has checked is fetched once more. */
  markCorrupt(file: File, message: string): void {
    if (!this.link.digest && !this.suspects.has(file.key)) {
      this.suspects.add(file.key);
      this.cache.drop(file.key);
      this.fail(file, new DamagedError(message, false));
      return;
    }
    this.failures.set(file.key, { message, lasting: true, tries: 1, until: Infinity });
  }

  /** Starts the best of the wanted downloads, as many as the link can use. */
  fill(wanted: readonly File[]): void {
    for (const file of wanted) {
      if (!this.hasRoom()) return;
      if (this.loads.has(file) || this.isBackingOff(file) || this.mayComeWhole(file)) continue;
      void this.run(this.requestFor(file, wanted));
    }
  }

  /** Whether a range may come with one that was asked for: from a server without ranges. */
  private mayComeWhole({ uri, offset }: File): boolean {
    return offset !== undefined && this.sendsRanges === null && this.isAsked(uri);
  }

  /** Whether a request for a file is on its way, besides one of them. */
  private isAsked(uri: string | undefined, besides?: Load): boolean {
    return [...this.loads.all].some((one) => one !== besides && one.files[0]?.uri === uri);
  }

  /** What is asked for together with a file: of ranges those that touch, of a server without ranges all. */
  private requestFor(file: File, wanted: readonly File[]): readonly File[] {
    const all = this.ranges.get(file.uri);
    if (this.sendsRanges === false) return all ?? [file];
    const missing = wanted.filter((one) => !this.loads.has(one) && !this.isBackingOff(one));
    const own = all ? consecutive(file, all, missing, this.room, this.few) : [file];
    const packed = this.fromPack(file, missing);
    return packed.length > own.length ? packed : own;
  }

  private fromPack(file: File, missing: readonly File[]): readonly File[] {
    if (!this.pack) return [];
    const sound = missing.filter(({ key }) => !this.failures.has(key)); // damaged there, perhaps
    const keys = new Set(sound.map(({ key }) => key));
    if (!keys.has(file.key)) return [];
    return this.pack.around(file, (key) => keys.has(key), Math.max(this.room, this.few));
  }

  /** Bytes of ranges that one request brings at least, if they are wanted. */
  private get few(): number {
    return Math.max(this.trip / REQUESTS_PER_TRIP, LEAST_REQUEST_BYTES) || LEAST_REQUEST_BYTES;
  }

  /** Bytes per round trip of the link; NaN: unknown. */
  private get trip(): number {
    return this.roundTrip < Infinity ? (this.roundTrip * this.bandwidth.rate) / 1000 : Number.NaN;
  }

  /** Aborts downloads that are no longer wanted, unless they are nearly complete. */
  keepOnly(wanted: ReadonlySet<string>): void {
    this.loads.keepOnly(wanted);
    this.pauseBandwidth();
    for (const key of this.arrived.keys()) if (!wanted.has(key)) this.arrived.delete(key);
  }

  /** Forgets failures, so that all files may be retried immediately. */
  clearFailures(): void {
    this.failures.clear();
    this.suspects.clear();
  }

  close(): void {
    this.closed = true;
    for (const load of this.loads.all) this.loads.drop(load);
    this.pauseBandwidth();
    this.arrived.clear();
    if (!this.options.cache) this.cache.clear();
  }

  /** Number of concurrent downloads: many for small files, to fill the link; more would only weaken the order. */
  private hasRoom(): boolean {
    const { size } = this.loads.all;
    if (this.closed || size >= (this.options.maxDownloads ?? MAX_DOWNLOADS)) return false;
    return size < 2 || this.room > 0;
  }

  /** Bytes that may be asked for. */
  private get room(): number {
    const { rate } = this.bandwidth;
    return (
      (Number.isNaN(rate)
        ? BYTES_AT_UNKNOWN_RATE
        : Math.max(SECONDS_IN_FLIGHT * rate, BYTES_AT_UNKNOWN_RATE / 2)) - this.loads.left
    );
  }

  private begin(): void {
    if (!this.running) this.bandwidth.running(true);
  }

  /** Stops the clock of the bandwidth where nothing is on its way. */
  private pauseBandwidth(): void {
    if (!this.running) this.bandwidth.running(false);
  }

  private store(file: File, content: Uint8Array): void {
    this.failures.delete(file.key);
    this.arrived.set(file.key, content);
    this.cache.put(file.key, content);
  }

  private async run(files: readonly File[]): Promise<void> {
    this.begin();
    const [file] = files as readonly [File];
    const isPack = file.uri === this.pack?.files[0]?.uri;
    const load = this.loads.begin(files, isPack);
    const again = files.some(({ key }) => this.failures.has(key));
    try {
      if (file.offset === undefined) await this.runFile(load, file, again);
      else await this.runRanges(load, files, again);
    } catch (error) {
      const missing = load.files.find((one) => this.loads.brings(load, one));
      if (isPack) this.leavePack(error);
      else if (missing) this.fail(missing, error);
    }
    if (load.dropped) return;
    this.loads.end(load);
    this.pauseBandwidth();
    this.options.changed();
  }

  /** All that the pack has comes otherwise from now on. */
  private leavePack(error: unknown): void {
    this.pack = null;
    if (error instanceof DamagedError) this.note = `${error.message}; files are loaded one by one.`;
  }

  private async runFile(load: Load, file: File, again: boolean): Promise<void> {
    const content = await download(this.link, file, load.abort, again, (got) => {
      load.got = got;
    });
    if (!load.dropped) this.store(file, content);
  }

  private async runRanges(load: Load, files: readonly File[], again: boolean): Promise<void> {
    const { isPack } = load;
    const all = (isPack ? this.pack?.files : this.ranges.get((files[0] as File).uri)) ?? files;
    const came = (file: File, then: () => void) => {
      if (load.dropped || (!this.loads.came(load, file) && this.isHere(file))) return;
      then();
      this.options.changed();
    };
    await downloadRanges(this.link, files, all, {
      abort: load.abort,
      again,
      besides: this.isAsked(files[0]?.uri, load),
      silence: isPack ? PACK_SILENCE : undefined,
      answered: (ranges) => {
        this.sendsRanges = ranges;
        if (ranges) return;
        load.files = all;
        load.isWhole = true;
        this.loads.claim(load, all);
      },
      take: (file, content) => {
        came(file, () => this.store(file, content));
      },
      corrupt: (file, error) =>
        came(file, () => {
          this.fail(file, error);
          this.damaged += Number(isPack);
          if (this.damaged > 1) this.pack = null; // what follows is likely damaged too
        }),
      progress: (got) => {
        load.got = got;
      },
    });
  }

  private fail(file: File, error: unknown): void {
    const { clock } = this.link;
    const tries = (this.failures.get(file.key)?.tries ?? 0) + 1;
    const known = error instanceof DownloadError ? error : new DownloadError(`${file.uri}: ${error}`, true);
    const lasting = known.lasting || (known instanceof DamagedError && tries > 1);
    const wait = Math.min(FIRST_WAIT * 2 ** (tries - 1), LONGEST_WAIT);
    this.failures.set(file.key, { message: known.message, lasting, tries, until: clock.now() + wait });
    if (!lasting) {
      clock.after(wait, () => {
        if (!this.closed) this.options.changed();
      });
    }
  }
}
