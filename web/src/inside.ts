/** A page that has its bundle inside (`sagesplat bundle --single-file`): it opens from the disk, and asks nobody. */

import type { Fetch, Reply } from "./core/download";

/** Where a bundle's files come from. */
export interface Source {
  readonly base: URL; // of the bundle's folder, ending in a slash
  readonly fetch: Fetch;
}

const BASE = new URL("https://bundle.invalid/"); // never asked

/** The files inside the page: base64 in elements that browsers do not run; null for an ordinary page. */
export function sourceInside(page: ParentNode): Source | null {
  const elements = page.querySelectorAll<HTMLScriptElement>("script[data-uri]");
  if (!elements.length) return null;
  const files = new Map([...elements].map((one) => [new URL(one.dataset.uri ?? "", BASE).href, one]));
  return {
    base: BASE,
    fetch: async (url) => {
      const element = files.get(url);
      return element ? replyOf(bytesOf(element.textContent ?? "")) : MISSING;
    },
  };
}

const MISSING: Reply = {
  ok: false,
  status: 404,
  headers: { get: () => null },
  body: null,
  text: async () => "",
};

function replyOf(content: Uint8Array): Reply {
  let next: Uint8Array | undefined = content;
  const read = async () => {
    const value = next;
    next = undefined;
    return { done: !value, value };
  };
  const text = async () => new TextDecoder().decode(content);
  return { ok: true, status: 200, headers: { get: () => null }, body: { getReader: () => ({ read }) }, text };
}

/** Bytes of base64, without the help of browsers older than 2025 where they lack it. */
export function bytesOf(text: string): Uint8Array {
  const native = (Uint8Array as { fromBase64?: (text: string) => Uint8Array }).fromBase64;
  if (native) return native.call(Uint8Array, text);
  const binary = atob(text);
  const out = new Uint8Array(binary.length);
  for (let i = 0; i < out.length; i++) out[i] = binary.charCodeAt(i);
  return out;
}
