/** Downloads single files of a bundle and verifies their content. */

/** The subset of `fetch` that is used here. */
export type Fetch = (url: string, init?: RequestInit) => Promise<Reply>;

/** The subset of `Response` that is used here. */
export interface Reply {
  readonly ok: boolean;
  readonly status: number;
  readonly headers: { get(name: string): string | null };
  readonly body: { getReader(): Reader } | null;
  readonly isEarly?: boolean; // it was asked for before, so that its time says nothing of the link
  text(): Promise<string>;
}

export interface Reader {
  read(): Promise<{ readonly done: boolean; readonly value?: Uint8Array | undefined }>;
}

/** The clock, which tests replace. */
export interface Clock {
  now(): number; // ms
  /** Runs a callback after some ms; the returned function cancels it. */
  after(ms: number, run: () => void): () => void;
}

/** Lower-case hexadecimal SHA-256; null if the page cannot compute it (plain http). */
export type Digest = ((bytes: Uint8Array) => Promise<string>) | null;

export interface File {
  readonly uri: string;
  readonly offset?: number; // where a range of a larger file begins
  readonly bytes: number;
  readonly key: string; // its own; the same of the same content in a pack
  readonly sha256: string; // or its first digits
}

/** Why a download failed; with `lasting`, a retry is useless. */
export class DownloadError extends Error {
  override name = "DownloadError";
  constructor(
    message: string,
    readonly lasting: boolean,
  ) {
    super(message);
  }
}

const SILENCE = 10_000; // ms without data after which a download counts as failed

/** How to download; `received` is called for every chunk of data. */
export interface Link {
  readonly base: URL;
  readonly fetch: Fetch;
  readonly clock: Clock;
  readonly digest: Digest;
  received(bytes: number): void;
  /** Called with a server's response time, ms. */
  answered(ms: number): void;
}

/**
 * Downloads and verifies a file, once. Rejects with a DownloadError in one line.
 *
 * @param signal - aborts it
 * @param again - bypasses the browser's cache, which may hold a damaged copy
 * @param progress - called with the number of bytes received
 */
export async function download(
  link: Link,
  file: File,
  signal: AbortController,
  again: boolean,
  progress: (bytes: number) => void,
): Promise<Uint8Array> {
  const parts: Uint8Array[] = [];
  let size = 0;
  await receive(link, file, signal, { again }, (part) => {
    parts.push(part);
    size += part.length;
    progress(size);
    return size <= file.bytes;
  });
  return await intact(link, file, joined(parts, size));
}

/** Bytes of a file, from `start` to before `end`. */
export interface Range {
  readonly start: number;
  readonly end: number;
}

/** Options of `receive`. */
export interface ReceiveOptions {
  readonly range?: Range; // all that is asked for
  readonly again?: boolean; // bypasses the browser's cache
  readonly besides?: boolean; // other ranges of the file are on their way: Chromium's cache would wait for each
  readonly silence?: number | undefined; // ms without data after which the download counts as failed
  readonly check?: (reply: Reply) => void; // throws for an unusable response
}

/** Passes a file's body to `take` in chunks until it returns false. Rejects with a DownloadError. */
export async function receive(
  link: Link,
  file: File,
  signal: AbortController,
  { again = false, besides = false, silence = SILENCE, check, range }: ReceiveOptions,
  take: (part: Uint8Array) => boolean,
): Promise<void> {
  const { fetch, clock } = link; // the browser's fetch must not be called as a method
  let silent = false;
  const watch = () =>
    clock.after(silence, () => {
      silent = true;
      signal.abort();
    });
  let stop = watch();
  try {
    const url = new URL(file.uri, link.base).href;
    const asked = clock.now();
    const reply = await fetch(url, {
      signal: signal.signal,
      ...(besides && { cache: "no-store" as const }),
      ...(again && { cache: "reload" as const }),
      ...(range && { headers: { Range: `bytes=${range.start}-${range.end - 1}` } }),
    });
    if (range && !reply.isEarly) link.answered(clock.now() - asked); // a page may have preloaded others
    if (!reply.ok) throw refused(file, reply.status);
    check?.(reply);
    await each(reply, (part) => {
      stop();
      stop = watch();
      link.received(part.length);
      return take(part);
    });
  } catch (error) {
    if (error instanceof DownloadError) throw error;
    throw new DownloadError(
      `${file.uri}: ${silent ? "the server fell silent" : "the connection broke"}`,
      false,
    );
  } finally {
    stop();
    signal.abort(); // stops the rest of an unexpected body
  }
}

/** Calls `take` for each chunk of the body until it returns false. */
async function each(reply: Reply, take: (part: Uint8Array) => boolean): Promise<void> {
  const reader = reply.body?.getReader();
  for (;;) {
    const next = await reader?.read();
    if (!next || next.done) return;
    if (next.value && !take(next.value)) return;
  }
}

function refused(file: File, status: number): DownloadError {
  if (status === 416)
    return new DamagedError(`${file.uri}: the server has fewer bytes than the manifest`, false);
  const passes = status >= 500 || status === 408 || status === 429;
  return new DownloadError(`${file.uri}: the server said ${status}`, !passes);
}

/** The content if it has the size and hash in the manifest; damage may be temporary, so a retry is allowed. */
export async function intact(
  link: Pick<Link, "digest">,
  file: File,
  content: Uint8Array,
): Promise<Uint8Array> {
  const { uri, offset, bytes } = file;
  const name = offset === undefined ? uri : `${uri}, ${bytes} bytes from ${offset} on,`;
  if (content.length !== bytes) {
    const is = content.length < bytes ? `only ${content.length}` : `more than`;
    throw new DamagedError(`${name} is damaged: ${is} of ${bytes} bytes`, false);
  }
  if (link.digest && !(await link.digest(content)).startsWith(file.sha256)) {
    throw new DamagedError(`${name} is damaged: its sha-256 is not that of the manifest`, false);
  }
  return content;
}

/** The file does not have the size or hash in the manifest. */
export class DamagedError extends DownloadError {}

function joined(parts: readonly Uint8Array[], size: number): Uint8Array {
  const out = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    out.set(part, at);
    at += part.length;
  }
  return out;
}

/** SHA-256 by the browser, which offers it on https and localhost only. */
export const digestOfBrowser: Digest = globalThis.crypto?.subtle
  ? async (bytes) => {
      const hash = await crypto.subtle.digest("SHA-256", bytes as Uint8Array<ArrayBuffer>);
      return Array.from(new Uint8Array(hash), (byte) => byte.toString(16).padStart(2, "0")).join("");
    }
  : null;

export const clockOfBrowser: Clock = {
  now: () => performance.now(),
  after(ms, run) {
    const timer = setTimeout(run, ms);
    return () => clearTimeout(timer);
  },
};
