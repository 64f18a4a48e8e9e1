/** The pack, asked for before the manifest is there. */

import { expect, test } from "vitest";
import { inAdvance } from "../../src/core/advance";
import { Pack } from "../../src/core/pack";
import { Network, VirtualClock } from "../simulate";
import { world } from "../world";
import { BASE } from "../worlds";

const url = (path: string) => new URL(path, BASE).href;

function made() {
  const clock = new VirtualClock();
  const network = new Network(clock);
  network.files.set("a.pack", Uint8Array.of(1, 2, 3));
  return { clock, network, advance: inAdvance(network.fetch, url("a.pack"), 2) };
}

const BEGINNING = { headers: { Range: "bytes=0-1" } };

test("who asks first gets the answer that is on its way, others their own", async () => {
  const { clock, network, advance } = made();
  await clock.pass(90);
  let [first, second] = ["", ""];
  void advance.fetch(url("a.pack"), BEGINNING).then(async (reply) => {
    expect(reply.isEarly).toBe(true);
    first = await reply.text();
  });
  void advance.fetch(url("a.pack"), BEGINNING).then(async (reply) => {
    second = await reply.text();
  });
  await clock.pass(20);
  expect([first, second]).toEqual(["\x01\x02", ""]);
  await clock.pass(100);
  expect(second).toBe(first);
  expect(network.asked).toEqual(["a.pack", "a.pack"]);
});

test.each<["offline" | 404]>([["offline"], [404]])(
  "an early answer of %s is asked for again",
  async (fault) => {
    const { clock, network } = made();
    network.faults.set("a.pack", [fault]);
    const advance = inAdvance(network.fetch, url("a.pack"), 2);
    let text = "";
    void advance.fetch(url("a.pack"), BEGINNING).then(async (reply) => {
      text = await reply.text();
    });
    await clock.pass(300);
    expect(text).toBe("\x01\x02");
  },
);

test("another part of it is asked for by itself", async () => {
  const { clock, network, advance } = made();
  let text = "";
  void advance.fetch(url("a.pack"), { headers: { Range: "bytes=0-0" } }).then(async (reply) => {
    text = await reply.text();
  });
  await clock.pass(300);
  expect(text).toBe("\x01");
  expect(network.askedRanges).toEqual(["a.pack 0-1", "a.pack 0-0"]);
});

test("nobody wants it: it is stopped; who has it stops it", async () => {
  const one = made();
  one.advance.cancel();
  await one.clock.pass(10);
  expect(one.network.aborted).toEqual(["a.pack"]);
  const two = made();
  const abort = new AbortController();
  two.advance.fetch(url("a.pack"), { ...BEGINNING, signal: abort.signal }).catch(() => {});
  two.advance.cancel();
  await two.clock.pass(10);
  expect(two.network.aborted).toEqual([]);
  abort.abort();
  await two.clock.pass(10);
  expect(two.network.aborted).toEqual(["a.pack"]);
});

test("a bundle is drawn a round trip earlier", async () => {
  const firstDrawn = async (early: boolean) => {
    const w = world({ labels: 2, levels: 3, pack: true, streams: true });
    const { network, clock, manifest } = w;
    const bytes = new Pack(manifest).beginning.reduce((sum, file) => sum + file.bytes, 0);
    const fetch = early ? inAdvance(network.fetch, url("scene-1.pack"), bytes).fetch : network.fetch;
    await clock.pass(100); // the manifest's
    const { streamer } = world({}, { manifest, fetch }, w);
    const begun = clock.now();
    streamer.start();
    while (!streamer.state.labels.every(({ shown }) => shown)) await clock.pass(5);
    return clock.now() - begun;
  };
  expect(await firstDrawn(false)).toBeGreaterThan((await firstDrawn(true)) + 90);
});
