/** Decodes coded streams in workers, or on the page's own thread where there are none. */

import { Palette } from "../core/palette";
import { StreamDecoder } from "../core/stream";
import { Packing, type Part } from "./packing";

/** Increments of a stream to decode, in their order; the last one is asked for. */
export interface Job {
  readonly id: number;
  readonly stream: number;
  readonly from: number; // increments that were decoded before; 0: the stream begins anew
  readonly increments: readonly Uint8Array[];
  readonly palette?: PaletteBytes | undefined; // of the file, where the stream begins anew
}

/** A palette as it came, and what it is known by. */
export interface PaletteBytes {
  readonly key: string;
  readonly bytes: Uint8Array;
}

/** The answer to a job. */
export interface Answer {
  readonly id: number;
  readonly part: Part | null; // null: the stream is damaged
}

/** The streams that are being decoded, each where it was left. */
export class Streams {
  private readonly decoders = new Map<number, StreamDecoder<Part>>();
  private readonly palettes = new Map<string, Palette>(); // by key: many streams have the same

  /** Decodes the increments of a job; a part for the last one. */
  answer({ id, stream, from, increments, palette }: Job): Answer {
    try {
      const decoder = from
        ? this.decoders.get(stream)
        : new StreamDecoder(new Packing(), palette ? this.paletteOf(palette) : null);
      if (!decoder) throw new Error("a stream that was not begun");
      this.decoders.set(stream, decoder);
      let parts: Part[] = [];
      for (const bytes of increments) parts = decoder.push(bytes).filter(({ count }) => count > 0);
      const [part, ...others] = parts;
      if (!part || others.length || decoder.isWithin) throw new Error("not one level");
      if (decoder.isComplete) this.decoders.delete(stream);
      return { id, part };
    } catch {
      this.decoders.delete(stream);
      return { id, part: null };
    }
  }

  private paletteOf({ key, bytes }: PaletteBytes): Palette {
    const palette = this.palettes.get(key) ?? new Palette(bytes);
    this.palettes.set(key, palette);
    return palette;
  }
}

/** The subset of `Worker` that is used here. */
export interface Peer {
  postMessage(jobs: readonly Job[]): void;
  terminate(): void;
}

/** Starts a worker; throws where none can be had. */
export type Start = (answered: (answers: readonly Answer[]) => void, failed: () => void) => Peer;

interface Waiting {
  readonly stream: number;
  readonly increments: readonly Uint8Array[]; // all from the first one on
  readonly palette: PaletteBytes | undefined;
  readonly done: (part: Part | null) => void;
}

/** Decodes the levels of several streams, each by one of several workers. */
export class Decoders {
  private readonly all: readonly Decoder[];
  private readonly byStream = new Map<number, Decoder>();

  constructor(start: Start, workers: number) {
    this.all = Array.from({ length: workers }, () => new Decoder(start));
  }

  /**
   * Decodes the newest of the increments; rejects for a damaged stream.
   *
   * @param stream - a number of the caller's
   * @param increments - of the stream, from the first one to the one that is asked for
   * @param palette - of its file, if it needs one
   */
  decode(stream: number, increments: readonly Uint8Array[], palette?: PaletteBytes): Promise<Part> {
    const next = this.all[this.byStream.size % this.all.length] as Decoder;
    const decoder = this.byStream.get(stream) ?? next;
    this.byStream.set(stream, decoder);
    return decoder.decode(stream, increments, palette);
  }

  close(): void {
    for (const decoder of this.all) decoder.close();
  }
}

/** One worker, and what it was sent. */
class Decoder {
  private peer: Peer | null = null;
  private own: Streams | null = null; // where no worker can be had
  private jobs = 0;
  private outbox: Job[] = []; // asked for at once, sent at once: a message takes as long as 100 Gaussians
  private readonly waiting = new Map<number, Waiting>();
  private readonly done = new Map<number, number>(); // increments decoded, by stream

  constructor(private readonly start: Start) {}

  decode(stream: number, increments: readonly Uint8Array[], palette?: PaletteBytes): Promise<Part> {
    return new Promise((resolve, reject) => {
      const done = (part: Part | null) => {
        if (part) return resolve(part);
        this.done.delete(stream);
        reject(new Error("a damaged stream"));
      };
      const id = ++this.jobs;
      this.waiting.set(id, { stream, increments, palette, done });
      this.send(id, this.done.get(stream) ?? 0);
    });
  }

  close(): void {
    this.peer?.terminate();
    this.peer = null;
    this.own = null;
    this.outbox = [];
    this.waiting.clear();
    this.done.clear();
  }

  private send(id: number, decoded: number): void {
    const job = this.waiting.get(id);
    if (!job) return;
    const { stream, increments, palette } = job;
    const from = decoded < increments.length ? decoded : 0; // an earlier one: from the beginning
    this.done.set(stream, increments.length);
    const message: Job = {
      id,
      stream,
      from,
      increments: increments.slice(from),
      ...(!from && palette && { palette }),
    };
    if (!this.outbox.length) queueMicrotask(() => this.post());
    this.outbox.push(message);
  }

  private post(): void {
    const jobs = this.outbox;
    this.outbox = [];
    if (!jobs.length) return;
    const peer = this.worker();
    if (peer) peer.postMessage(jobs);
    else if (this.own) for (const job of jobs) this.take(this.own.answer(job));
  }

  private take({ id, part }: Answer): void {
    const job = this.waiting.get(id);
    this.waiting.delete(id);
    job?.done(part);
  }

  private worker(): Peer | null {
    if (this.peer || this.own) return this.peer;
    try {
      this.peer = this.start(
        (answers) => {
          for (const answer of answers) this.take(answer);
        },
        () => this.fallBack(),
      );
    } catch {
      this.own = new Streams();
    }
    return this.peer;
  }

  /** Goes on without the worker: what it had not answered begins anew here. */
  private fallBack(): void {
    this.peer?.terminate();
    this.peer = null;
    this.own = new Streams();
    this.outbox = [];
    this.done.clear();
    for (const id of [...this.waiting.keys()]) this.send(id, 0);
  }
}
