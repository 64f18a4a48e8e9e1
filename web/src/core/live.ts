/** Polls the manifest of a bundle whose training still runs. */

import type { Manifest } from "../types";
import type { Clock, Fetch } from "./download";
import { parseManifest } from "./manifest";
import { BundleError } from "./schema";

const EVERY = 2000; // ms

export interface Following {
  readonly url: string;
  readonly fetch: Fetch;
  readonly clock: Clock;
  isActive(): boolean;
  /** Whether the previous manifest is drawn; else a slow link would never finish one. */
  isFree(): boolean;
  changed(manifest: Manifest): void;
  failed(message: string): void;
}

/** Polls every two seconds, and passes on each manifest that differs from the previous one. */
export function poll(following: Following): void {
  const { url, fetch, clock, isActive, isFree, changed, failed } = following;
  let tag: string | null = null;
  let last = "";
  const ask = async () => {
    const reply = await fetch(url, tag ? { headers: { "If-None-Match": tag } } : { cache: "no-cache" });
    if (reply.status === 304) return;
    if (!reply.ok) throw new BundleError(`${url}: the server said ${reply.status}`);
    const text = await reply.text();
    if (!isActive()) return;
    tag = reply.headers.get("ETag");
    if (text !== last) changed(parseManifest(text));
    last = text;
  };
  const next = () => {
    clock.after(EVERY, async () => {
      if (!isActive()) return;
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
