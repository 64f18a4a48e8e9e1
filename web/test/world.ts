/** A streamer in a world of its own, watched at every moment. */

import { Streamer, type StreamerOptions } from "../src/core/streamer";
import type { CellState, Manifest, Settings, State } from "../src/types";
import { digest, FakeRenderer, Network, VirtualClock } from "./simulate";
import { BASE, bundle, DEFAULTS, type Options } from "./worlds";

export interface World {
  readonly clock: VirtualClock;
  readonly network: Network;
  readonly renderer: FakeRenderer;
  readonly manifest: Manifest;
  readonly streamer: Streamer;
  settings: Settings; // that hold now
  set(partial: Partial<Settings>): void;
  /** Lets time pass; checks what must hold at every moment. */
  pass(ms: number): Promise<void>;
  /** Lets time pass until the streamer is idle; fails after a minute. */
  rest(): Promise<void>;
  /** Changes settings, starts the streamer if it is new, and rests. */
  run(partial?: Partial<Settings>): Promise<void>;
}

export function world(options: Options = {}, more: Partial<StreamerOptions> = {}, on?: World): World {
  const clock = on?.clock ?? new VirtualClock();
  const network = on?.network ?? new Network(clock);
  const renderer = new FakeRenderer(clock);
  renderer.begins = [1, ...(options.replaces ?? [])];
  const manifest = more.manifest ?? bundle(network, options);
  renderer.palettes = manifest.labels.map(({ palette }) => palette?.sha256);
  const settings = more.settings ?? DEFAULTS;
  const streamer = new Streamer({
    manifest,
    base: BASE,
    renderer,
    settings,
    clock,
    fetch: network.fetch,
    digest,
    ...more,
  });
  const check = watcher(streamer, renderer);
  renderer.watch = () => queueMicrotask(check);
  const made: World = {
    clock,
    network,
    renderer,
    manifest,
    streamer,
    settings,
    set(partial) {
      made.settings = { ...made.settings, ...partial };
      streamer.set(partial);
    },
    pass: (ms) => clock.pass(ms, check),
    async rest() {
      let idle = false;
      void streamer.idle().then(() => {
        idle = true;
      });
      for (let second = 0; second < 60; second++) {
        await clock.pass(1000, check);
        if (idle) return;
      }
      throw new Error(`never idle: ${JSON.stringify(streamer.state)}`);
    },
    run(partial = {}) {
      made.set(partial);
      streamer.start();
      return made.rest();
    },
  };
  return made;
}

/** What must hold at every moment: no holes, and the state says what is drawn. */
function watcher(streamer: Streamer, renderer: FakeRenderer): () => void {
  const seen = new Set<number>(); // cells
  const { live } = streamer.manifest; // there the old may be drawn for the new
  return () => {
    const { labels, count, gpuBytes } = streamer.state;
    const all = labels.flatMap(({ cells }) => cells);
    for (const id of seen) if (!all.some(({ cell }) => cell.id === id)) seen.delete(id);
    let [drawn, uploaded] = [0, 0];
    for (const { cell, shown, wanted } of all) {
      const levels = renderer.levels(cell.id);
      const start = cell.levels.slice(0, shown).findLastIndex(({ refine }) => refine);
      const isDrawn = (i: number) => i >= start && i < shown;
      const expected = cell.levels.flatMap((_, i) => (isDrawn(i) ? [i + 1] : []));
      if (!live && levels.join() !== expected.join()) {
        throw new Error(`cell ${cell.id}: draws ${levels}, says ${expected}`);
      }
      if (seen.has(cell.id) && wanted && !shown) throw new Error(`cell ${cell.id}: a hole`);
      if (shown) seen.add(cell.id);
      else if (!wanted) seen.delete(cell.id); // left out, since the budget is that small
      const there = renderer.uploaded.get(cell.id) ?? [];
      uploaded += there.reduce((sum, { level }) => sum + (cell.levels[level - 1]?.gpuBytes ?? 0), 0);
      drawn += cell.levels.reduce((sum, file, i) => sum + (isDrawn(i) ? file.count : 0), 0);
    }
    if (!live && uploaded !== gpuBytes) throw new Error(`says ${gpuBytes} bytes, the GPU has ${uploaded}`);
    if (!live && drawn !== count) throw new Error(`counts ${count}, draws ${drawn}`);
  };
}

/** Levels that are drawn, by cell. */
export const shown = (state: State): number[] => cellsOf(state).map((cell) => cell.shown);
export const wanted = (state: State): number[] => cellsOf(state).map((cell) => cell.wanted);
export const cellsOf = ({ labels }: State): CellState[] => labels.flatMap(({ cells }) => cells);
