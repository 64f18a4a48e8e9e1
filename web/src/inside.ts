/** A page that has its bundle inside (`sagesplat bundle --single-file`): it opens from the disk, and asks nobody. */

import type { Fetch, Reply } from "./core/download";

/** Where a bundle's files come from. */
export interface Source {
  readonly base: URL; // of the bundle's folder, ending in a slash
  readonly fetch: Fetch;
  readonly isInside?: boolean; // the page holds the files
}

const BASE = new URL("https://bundle.invalid/"); // never asked

/** The files inside the page: base64 in elements that browsers do not run; null for an ordinary page. */
export function sourceInside(page: ParentNode): Source | null {
  const elements = page.querySelectorAll<HTMLScriptElement>("script[data-uri]");
  if (!elements.length) return null;
  const files = new Map([...elements].map((one) => [new URL(one.dataset.uri ?? "", BASE).href, one]));
  return {
    base: BASE,
    isInside: true,
    fetch: async (url, init) => {
      const text = files.get(url)?.textContent;
      if (text === undefined || text === null) return MISSING;
      const range = /^bytes=(\d+)-(\d+)$/.exec(new Headers(init?.headers).get("Range") ?? "");
      return range
        ? replyOf(rangeOf(text, Number(range[1]), Number(range[2])), range[0])
        : replyOf(bytesOf(text));
    },
  };
}

/** A file of a source as a whole. */
export async function bytesFrom(source: Source, uri: string): Promise<ArrayBuffer> {
  const reply = await source.fetch(new URL(uri, source.base).href);
  const reader = reply.ok ? reply.body?.getReader() : undefined;
  const parts: Uint8Array[] = [];
  for (;;) {
    const { value } = (await reader?.read()) ?? {};
    if (!value) break;
    parts.push(value);
  }
  if (!parts.length) throw new Error(`${uri} is missing; write the bundle again.`);
  return new Blob(parts as BlobPart[]).arrayBuffer();
}

const MISSING: Reply = {
  ok: false,
  status: 404,
  headers: { get: () => null },
  body: null,
  text: async () => "",
};

/** Bytes `start` to `end` of what base64 holds: four letters are three bytes. */
function rangeOf(text: string, start: number, end: number): Uint8Array {
  const first = Math.floor(start / 3);
  return bytesOf(text.slice(4 * first, 4 * Math.floor(end / 3) + 4)).subarray(
    start - 3 * first,
    end + 1 - 3 * first,
  );
}

function replyOf(content: Uint8Array, range = ""): Reply {
  let next: Uint8Array | undefined = content;
  const read = async () => {
    const value = next;
    next = undefined;
    return { done: !value, value };
  };
  const text = async () => new TextDecoder().decode(content);
  const said = range && `${range.replace("=", " ")}/*`;
  const headers = { get: (name: string) => (said && name === "Content-Range" ? said : null) };
  return { ok: true, status: range ? 206 : 200, headers, body: { getReader: () => ({ read }) }, text };
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
