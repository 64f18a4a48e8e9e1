/** A bundle whose training goes on: its manifest is asked for again and again. */

import type { Manifest } from "../types";
import { BundleError } from "./check";
import type { Clock, Fetch } from "./download";
import { parseManifest } from "./manifest";

const EVERY = 2000; // ms

export interface Following {
  readonly url: string;
  readonly fetch: Fetch;
  readonly clock: Clock;
  goesOn(): boolean;
  /** Whether the manifest before is drawn; on a slow link none would ever be, if newer ones came between. */
  isFree(): boolean;
  found(manifest: Manifest): void;
  failed(message: string): void;
}

/** Asks every two seconds, and hands over each manifest that differs from the one before. */
export function poll(following: Following): void {
  const { url, fetch, clock, goesOn, isFree, found, failed } = following;
  let tag: string | null = null;
  let last = "";
  const ask = async () => {
    const reply = await fetch(url, tag ? { headers: { "If-None-Match": tag } } : { cache: "no-cache" });
    if (reply.status === 304) return;
    if (!reply.ok) throw new BundleError(`${url}: the server said ${reply.status}`);
    const text = await reply.text();
    if (!goesOn()) return;
    tag = reply.headers.get("ETag");
    if (text !== last) found(parseManifest(text));
    last = text;
  };
  const next = () => {
    clock.after(EVERY, async () => {
      if (!goesOn()) return;
      try {
        if (isFree()) await ask();
      } catch (error) {
        failed(error instanceof BundleError ? error.message : `${url}: cannot be reached; trying again`);
      }
      next();
    });
  };
  next();
}
