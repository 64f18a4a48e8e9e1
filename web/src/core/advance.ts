/** Asks for a file before anybody knows that it is needed. */

import type { Fetch } from "./download";

/** A fetch that has one file's answer on its way. */
export interface Advance {
  readonly fetch: Fetch;
  /** Stops the answer, unless somebody has it. */
  cancel(): void;
}

/** Asks for a file at once; who asks for it first gets that answer. */
export function inAdvance(fetch: Fetch, url: string): Advance {
  const abort = new AbortController();
  let early: ReturnType<Fetch> | null = fetch(url, { signal: abort.signal });
  early.catch(() => {}); // who takes it asks again
  return {
    fetch: async (asked, init) => {
      if (asked !== url || !early || init?.cache || init?.headers) return fetch(asked, init);
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
