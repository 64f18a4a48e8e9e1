/** Streams decoded by a worker, level by level, from where it was left. */

import { expect, test } from "vitest";
import { type Answer, Decoders, type Job, Streams } from "../../src/view/decoding";
import { bytesOf, type Golden, golden, paletteBytesOf } from "../golden";
import { settled } from "../simulate";

/** The ranges of levels with Gaussians, and how many each has; empty ones go with the next, or the last. */
function ranges(one: Golden): { increments: Uint8Array[]; counts: number[] } {
  const counts = one.sizes.map((size, i) => size - (one.sizes[i - 1] ?? 0));
  const filled = counts.flatMap((count, i) => (count ? i : []));
  const ends = filled.map((level, i) => (i === filled.length - 1 ? one.ends.at(-1) : one.ends[level]));
  const bytes = bytesOf(one);
  const increments = ends.map((end, i) => bytes.slice(i ? ends[i - 1] : 0, end));
  return { increments, counts: filled.map((level) => counts[level] as number) };
}

/** A worker in this thread, that fails when told to. */
class FakeWorker {
  readonly jobs: Job[] = [];
  readonly streams = new Streams();
  dead = false;
  closed = false;
  constructor(
    readonly answered: (answers: readonly Answer[]) => void,
    readonly failed: () => void,
  ) {}
  messages = 0;
  postMessage(jobs: readonly Job[]): void {
    this.messages++;
    this.jobs.push(...structuredClone(jobs));
    queueMicrotask(() => {
      if (this.closed) return;
      if (this.dead) this.failed();
      else this.answered(jobs.map((job) => this.streams.answer(job)));
    });
  }
  terminate(): void {
    this.closed = true;
  }
}

function made(count = 1) {
  const workers: FakeWorker[] = [];
  const decoders = new Decoders((answered, failed) => {
    const worker = new FakeWorker(answered, failed);
    workers.push(worker);
    return worker;
  }, count);
  const worker = () => workers[0] as FakeWorker;
  return { decoders, worker, workers };
}

function paletteIn(one: Golden) {
  const bytes = paletteBytesOf(one);
  return bytes && { key: one.name, bytes };
}

const many = golden.filter(({ sizes }) => sizes.length > 1);

test.each(many)("$name: each level goes on where the one before ended", async (one) => {
  const { decoders, worker } = made();
  const { increments, counts } = ranges(one);
  for (const [i, count] of counts.entries()) {
    const part = await decoders.decode(7, increments.slice(0, i + 1), paletteIn(one));
    expect(part.count).toBe(count);
    expect(worker().jobs.at(-1)).toMatchObject({ from: i, increments: { length: 1 } });
    expect(worker().jobs.at(-1)?.palette).toEqual(i ? undefined : paletteIn(one));
  }
});

test("an earlier level is decoded again from what was kept", async () => {
  const { decoders, worker } = made();
  const { increments, counts } = ranges(golden.find(({ name }) => name.startsWith("degree 3")) as Golden);
  const first = [];
  for (let i = 1; i <= counts.length; i++) first.push(await decoders.decode(1, increments.slice(0, i)));
  for (const level of [2, 3, 1, 2]) {
    expect(await decoders.decode(1, increments.slice(0, level))).toEqual(first[level - 1]);
  }
  expect(worker().jobs.map(({ from }) => from)).toEqual([0, 1, 2, 0, 2, 0, 1]);
});

test("streams do not mix", async () => {
  const { decoders, worker } = made();
  const both = many.slice(0, 2).map(ranges);
  const parts = both.map(({ increments }, stream) => decoders.decode(stream, increments.slice(0, 1)));
  await Promise.all(parts);
  expect(worker().messages).toBe(1); // what is asked for at once goes at once
  for (const [stream, { increments, counts }] of both.entries()) {
    expect((await decoders.decode(stream, increments.slice(0, 2))).count).toBe(counts[1]);
  }
});

test("streams are shared out to the workers, and each stays where it began", async () => {
  const { decoders, workers } = made(3);
  const { increments, counts } = ranges(golden.find(({ name }) => name.startsWith("degree 3")) as Golden);
  for (let level = 1; level <= counts.length; level++) {
    for (const stream of [0, 32, 64, 96]) await decoders.decode(stream, increments.slice(0, level));
  }
  const jobs = workers.map((worker) => worker.jobs);
  expect(jobs.map((own) => new Set(own.map(({ stream }) => stream)))).toEqual(
    [[0, 96], [32], [64]].map((own) => new Set(own)),
  );
  expect(jobs.flat().filter(({ from }) => !from).length).toBe(4);
  decoders.close();
  expect(workers.every(({ closed }) => closed)).toBe(true);
});

test("a damaged level is an error, and the next one begins anew", async () => {
  const { decoders, worker } = made();
  const { increments } = ranges(many[1] as Golden);
  await decoders.decode(1, increments.slice(0, 1));
  const wrong = (increments[1] as Uint8Array).slice();
  wrong[wrong.length - 1] = (wrong.at(-1) ?? 0) ^ 1;
  await expect(decoders.decode(1, [increments[0] as Uint8Array, wrong])).rejects.toThrow("damaged");
  await decoders.decode(1, increments.slice(0, 2));
  expect(worker().jobs.map(({ from }) => from)).toEqual([0, 1, 0]);
  await expect(decoders.decode(2, [(increments[0] as Uint8Array).slice(0, -1)])).rejects.toThrow("damaged");
});

test("without workers the page decodes itself", async () => {
  const decoders = new Decoders(() => {
    throw new Error("blob: is not allowed");
  }, 2);
  const { increments, counts } = ranges(many[0] as Golden);
  for (const [i, count] of counts.entries()) {
    expect((await decoders.decode(1, increments.slice(0, i + 1))).count).toBe(count);
  }
});

test("a worker that fails between two messages loses nothing", async () => {
  const { decoders, worker } = made();
  const { increments, counts } = ranges(many[1] as Golden);
  await decoders.decode(1, increments.slice(0, 1));
  const second = decoders.decode(1, increments.slice(0, 2));
  worker().failed(); // before the message with the second level is posted
  const other = decoders.decode(2, increments.slice(0, 1));
  expect((await Promise.all([second, other])).map(({ count }) => count)).toEqual([counts[1], counts[0]]);
});

test("a worker that fails is replaced by the page, for what it had decoded too", async () => {
  const { decoders, worker, workers } = made();
  const { increments, counts } = ranges(many[1] as Golden);
  await decoders.decode(1, increments.slice(0, 1));
  worker().dead = true;
  expect((await decoders.decode(1, increments.slice(0, 2))).count).toBe(counts[1]);
  expect(worker().closed).toBe(true);
  expect((await decoders.decode(2, increments.slice(0, 1))).count).toBe(counts[0]);
  expect(workers.length).toBe(1);
});

test("nothing comes after the end", async () => {
  const { decoders, worker, workers } = made();
  let answered = false;
  const { increments } = ranges(many[0] as Golden);
  void decoders.decode(1, increments.slice(0, 1)).then(() => {
    answered = true;
  });
  await Promise.resolve(); // the message is posted
  void decoders.decode(2, increments.slice(0, 1)); // and this one is not
  decoders.close();
  await settled();
  expect(worker().closed).toBe(true);
  expect(worker().jobs.length).toBe(1);
  expect(workers.length).toBe(1);
  expect(answered).toBe(false);
});
