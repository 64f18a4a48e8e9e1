/** Asks for a file before anybody knows that it is needed. */

import type { Fetch } from "./download";

/** A fetch that has one file's answer on its way. */
export interface Advance {
  readonly fetch: Fetch;
  /** Stops the answer, unless somebody has it. */
  cancel(): void;
}

/**
 * Asks for the beginning of a file at once; who asks for it first gets that answer.
 *
 * @param bytes - of it
 */
export function inAdvance(fetch: Fetch, url: string, bytes: number): Advance {
  const abort = new AbortController();
  const headers = { Range: `bytes=0-${bytes - 1}` };
  let early: ReturnType<Fetch> | null = fetch(url, { signal: abort.signal, headers });
  early.catch(() => {}); // who takes it asks again
  return {
    fetch: async (asked, init) => {
      const isSame = asked === url && new Headers(init?.headers).get("Range") === headers.Range;
      if (!isSame || !early || init?.cache) return fetch(asked, init);
      const answer = early;
      early = null;
      init?.signal?.addEventListener("abort", () => abort.abort(), { once: true });
      try {
        const reply = await answer;
        const { ok, status, headers, body } = reply;
        if (ok) return { ok, status, headers, body, text: () => reply.text(), isEarly: true };
      } catch {
        // once more, and whoever asks learns why
      }
      return fetch(asked, init);
    },
    cancel: () => {
      if (early) abort.abort();
      early = null;
    },
  };
}
