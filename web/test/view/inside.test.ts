/** A bundle inside its page. */

import { expect, test } from "vitest";
import { loadManifest } from "../../src/core/manifest";
import { bytesFrom, bytesOf, sourceInside } from "../../src/inside";
import { Network, VirtualClock } from "../simulate";
import { bundle, documentOf } from "../worlds";

/** A page with these files, as far as it is asked for them. */
function page(files: Readonly<Record<string, Uint8Array>>): ParentNode {
  const elements = Object.entries(files).map(([uri, content]) => ({
    dataset: { uri },
    textContent: Buffer.from(content).toString("base64"),
  }));
  return { querySelectorAll: () => elements } as unknown as ParentNode;
}

test("an ordinary page has none", () => {
  expect(sourceInside(page({}))).toBeNull();
});

test("its files are found by their address in the bundle, and nothing else is", async () => {
  const manifest = bundle(new Network(new VirtualClock()), { labels: 1, levels: 1 });
  const chunk = Uint8Array.from({ length: 300 }, (_, i) => i % 256);
  const source = sourceInside(
    page({
      "manifest.json": new TextEncoder().encode(JSON.stringify(documentOf(manifest))),
      "chunks/a-01.spz": chunk,
    }),
  );
  if (!source) throw new Error("none");
  expect(await loadManifest(source.base, source.fetch)).toEqual(manifest);
  const url = (uri: string) => new URL(uri, source.base).href;
  for (let again = 0; again < 2; again++) {
    const reader = (await source.fetch(url("chunks/a-01.spz"))).body?.getReader();
    expect((await reader?.read())?.value).toEqual(chunk);
    expect((await reader?.read())?.done).toBe(true);
  }
  expect(await source.fetch(url("chunks/b-01.spz"))).toMatchObject({ ok: false, status: 404 });
});

test("a range of a file", async () => {
  const content = Uint8Array.from({ length: 100 }, (_, i) => i);
  const source = sourceInside(page({ "chunks/a.sgst": content }));
  if (!source) throw new Error("none");
  for (const [start, end] of [
    [0, 99],
    [0, 0],
    [1, 5],
    [2, 2],
    [33, 98],
    [99, 99],
  ] as const) {
    const headers = { Range: `bytes=${start}-${end}` };
    const reply = await source.fetch(new URL("chunks/a.sgst", source.base).href, { headers });
    expect(reply.status).toBe(206);
    expect(reply.headers.get("Content-Range")).toBe(`bytes ${start}-${end}/*`);
    expect([...((await reply.body?.getReader().read())?.value ?? [])]).toEqual([
      ...content.slice(start, end + 1),
    ]);
  }
});

test("base64 with and without the browser's help", () => {
  const bytes = Uint8Array.from({ length: 256 }, (_, i) => i);
  const text = Buffer.from(bytes).toString("base64");
  const native = Uint8Array as { fromBase64?: unknown };
  const before = native.fromBase64;
  native.fromBase64 = undefined;
  expect(bytesOf(text)).toEqual(bytes);
  native.fromBase64 = (given: string) => new Uint8Array(Buffer.from(given, "base64"));
  expect(bytesOf(text)).toEqual(bytes);
  native.fromBase64 = before;
});

test("a file that comes in pieces is put together, and a missing one is said", async () => {
  const pieces = [Uint8Array.of(1, 2), Uint8Array.of(3)];
  const fetch = async () => ({
    ok: true,
    status: 200,
    headers: { get: () => null },
    body: { getReader: () => ({ read: async () => ({ value: pieces.shift() }) }) },
    text: async () => "",
  });
  const source = { base: new URL("https://a.test/"), fetch } as unknown as Parameters<typeof bytesFrom>[0];
  expect([...new Uint8Array(await bytesFrom(source, "looks.jpg"))]).toEqual([1, 2, 3]);
  await expect(bytesFrom(source, "looks.jpg")).rejects.toThrow("looks.jpg is missing");
});
