/** Plans: cells of labels, modes, several budgets at once, what is always shipped, what nobody sees. */

import { describe, expect, test } from "vitest";
import { together } from "../../src/core/allocate";
import { fill } from "../../src/core/fill";
import { climb, nextSegment, type Segment } from "../../src/core/hull";
import { type Candidate, type Group, ladderOf, makePlan } from "../../src/core/planner";
import type { Settings } from "../../src/types";
import { Network, seeded, VirtualClock } from "../simulate";
import { bundle, DEFAULTS, NO_BUDGET } from "../worlds";

const random = seeded(3);
const { labels } = bundle(new Network(new VirtualClock()), { labels: 4, levels: 5, bytes: 900 });
// counts and bytes that do not go together, so that both budgets matter
const odd = labels.map(({ cells: [cell] }) => ({
  levels: (cell?.levels ?? []).map((level) => ({ ...level, count: 1 + Math.floor(100 * random()) })),
}));

const candidates = (changes: Partial<Candidate>[] = []): Candidate[] =>
  odd.map((cell, i) => ({
    ladder: ladderOf(cell),
    effort: ladderOf(cell).bytes,
    highest: 5,
    mean: [0.4, 0.6, 0.7, 0.8, 0.85],
    weight: 1,
    always: false,
    share: 0.1 * (i + 1),
    potential: 0.1 * (i + 1),
    visible: true,
    previous: 0,
    ...changes[i],
  }));
const settings = (partial: Partial<Settings>): Settings => ({ ...DEFAULTS, ...partial });
const BOUND = [0.35, 0.55, 0.65, 0.75, 0.8];

/** Levels by label, each planned as a whole; by bound. */
function plan(partial: Partial<Settings>, changes: Partial<Candidate>[] = [], bounds: number[][] = []) {
  const groups = candidates(changes).map((c, i) => ({ cells: [c], needed: 1, bound: bounds[i] ?? BOUND }));
  const { wanted, status } = makePlan(groups, settings({ quality: "ssim", ...partial }));
  return { wanted: wanted.flat(), status };
}

/** What a plan costs in all units. */
function cost(wanted: readonly number[], of = candidates()) {
  const sum = (unit: keyof Candidate["ladder"]) =>
    of.reduce((all, { ladder }, i) => all + (ladder[unit][(wanted[i] ?? 0) - 1] ?? 0), 0);
  return { bytes: sum("bytes"), gpuBytes: sum("gpuBytes"), count: sum("count") };
}

/** A cell whose levels cost these bytes. */
const cell = (bytes: number[], mean: number[], more: Partial<Candidate> = {}): Candidate => ({
  ladder: { bytes, gpuBytes: bytes, count: bytes },
  effort: bytes,
  highest: bytes.length,
  mean,
  weight: 1,
  always: false,
  share: 0.1,
  potential: 0.1,
  visible: true,
  previous: 0,
  ...more,
});
/** All segments of a cell's hull. */
function hull(cost: readonly number[], value: readonly number[]): Segment[] {
  const found: Segment[] = [];
  climb([cost], [value], [0], (segment) => Boolean(found.push(segment)));
  return found;
}

const planOf = (groups: Group[], partial: Partial<Settings> = {}) => makePlan(groups, settings(partial));

describe("cells of a label", () => {
  // of the near cell a byte brings three times as much
  const near = cell([10, 20, 40], [0.5, 0.8, 0.9], { share: 0.3 });
  const far = cell([10, 20, 40], [0.5, 0.8, 0.9]);

  test("are upgraded by gain per byte until their mean is what is needed", () => {
    const levels = (needed: number) => planOf([{ cells: [far, near], needed }]);
    expect(levels(0.5).wanted).toEqual([[1, 1]]);
    expect(levels(0.51).wanted).toEqual([[1, 2]]); // 0.725
    expect(levels(0.725).wanted).toEqual([[1, 2]]);
    expect(levels(0.73).wanted).toEqual([[2, 2]]); // slopes 0.003 and 0.0015
    expect(levels(0.81).wanted).toEqual([[2, 3]]); // 0.875
    expect(levels(0.88).wanted).toEqual([[3, 3]]);
    expect(levels(0.91)).toMatchObject({ wanted: [[3, 3]], status: "infeasible" });
    expect(levels(1)).toMatchObject({ wanted: [[3, 3]], status: "ok" });
    expect(levels(Infinity)).toMatchObject({ wanted: [[3, 3]], status: "infeasible" });
  });

  test("without a promise are shown in full, those out of sight are not", () => {
    const behind = cell([10, 20, 40], [0.5, 0.8, 0.9], { visible: false, share: 0 });
    expect(planOf([{ cells: [near, behind], needed: Number.NaN }]).wanted).toEqual([[3, 1]]);
    const unknown = cell([10, 20], [Number.NaN, Number.NaN]);
    expect(planOf([{ cells: [near, unknown], needed: 0.5 }]).wanted).toEqual([[3, 2]]);
    expect(planOf([{ cells: [{ ...near, weight: 0 }], needed: 0.8 }]).wanted).toEqual([[1]]);
  });

  test("that are there come before nearer ones that are not", () => {
    const there = { ...far, effort: [2.5, 5, 10] };
    expect(planOf([{ cells: [near, there], needed: 0.56 }]).wanted).toEqual([[1, 2]]);
    expect(planOf([{ cells: [near, far], needed: 0.56 }]).wanted).toEqual([[2, 1]]);
    expect(planOf([{ cells: [near, there], needed: 0.7 }]).wanted).toEqual([[2, 2]]);
  });

  test("of two that gain as much, the first comes first", () => {
    expect(planOf([{ cells: [far, { ...far }], needed: 0.6 }]).wanted).toEqual([[2, 1]]);
  });

  test("that have what is needed stay, unless a tenth of the bytes could be saved", () => {
    const held = (previous: number[], needed: number) => {
      const costs = [far, near].map(({ ladder }) => ladder.bytes);
      const means = [far, near].map(({ mean }) => mean);
      return together({ cost: costs, mean: means, share: [0.1, 0.3], previous }, needed).levels;
    };
    expect(held([1, 0], 0.57)).toEqual([1, 0]); // as many bytes
    expect(held([0, 2], 0.725)).toEqual([0, 1]); // 50 instead of 30 bytes
    expect(held([0, 0], 0.6)).toEqual([0, 1]); // too little
    expect(held([1, -1], 0.6)).toEqual([0, 1]); // one has come
    const few = {
      cost: [
        [100, 105],
        [100, 106],
      ],
      mean: [
        [0.5, 0.6],
        [0.5, 0.6],
      ],
      share: [1, 1],
    };
    expect(together({ ...few, previous: [1, 1] }, 0.5).levels).toEqual([1, 1]);
    expect(together(few, 0.5).levels).toEqual([0, 0]);
  });

  test("of a whole picture below equal levels, those of all labels get the rest", () => {
    const hard = cell([10, 20, 60], [0.3, 0.4, 0.9], { share: 0.1 });
    const easy = cell([10, 30, 90], [0.5, 0.95, 1], { share: 0.9 });
    expect(
      planOf([
        { cells: [hard], needed: 0.9 },
        { cells: [easy], needed: 0.5 },
      ]).wanted,
    ).toEqual([[3], [2]]);
  });

  test("reach it with at most a segment more than the cheapest that there are", () => {
    const dice = seeded(7);
    for (let round = 0; round < 200; round++) {
      const cells = Array.from({ length: 3 }, () => {
        let [bytes, mean] = [0, 0.2 * dice()];
        const steps = Array.from({ length: 4 }, () => {
          bytes += 1 + Math.floor(30 * dice());
          mean = Math.min(1, mean + 0.25 * dice());
          return [bytes, mean] as const;
        });
        return { cost: steps.map(([b]) => b), mean: steps.map(([, m]) => m), share: 0.05 + dice() };
      });
      const table = {
        cost: cells.map((c) => c.cost),
        mean: cells.map((c) => c.mean),
        share: cells.map((c) => c.share),
      };
      const needed = 0.3 + 0.5 * dice();
      const { levels, status } = together(table, needed);
      const whole = table.share.reduce((a, b) => a + b);
      const of = (levels: readonly number[]) => ({
        bytes: levels.reduce((sum, k, i) => sum + (table.cost[i]?.[k] ?? 0), 0),
        mean:
          levels.reduce((sum, k, i) => sum + (table.share[i] ?? 0) * (table.mean[i]?.[k] ?? 0), 0) / whole,
      });
      let best = Infinity;
      for (let code = 0; code < 64; code++) {
        const { bytes, mean } = of([code & 3, (code >> 2) & 3, code >> 4]);
        if (mean >= needed - 1e-9) best = Math.min(best, bytes);
      }
      expect(status).toBe(best < Infinity ? "ok" : "infeasible");
      if (status !== "ok") continue;
      const found = of(levels);
      expect(found.mean).toBeGreaterThanOrEqual(needed - 2e-9);
      const largest = Math.max(
        0,
        ...cells.flatMap((c) => hull(c.cost, c.mean).map((segment) => segment.more)),
      );
      expect(found.bytes).toBeLessThan(best + largest + 1e-9);
    }
  });
});

describe("budgets", () => {
  test("take the steepest segments that fit, also after one that does not", () => {
    const large = cell([10, 110], [0, 1], { share: 0.9 }); // 0.009 a byte
    const small = cell([10, 20, 40], [0, 0.06, 0.1]); // 0.0006, 0.0002
    const within = (bytes: number) =>
      planOf([{ cells: [large, small], needed: 1 }], { mode: "budget", budget: { ...NO_BUDGET, bytes } });
    expect(within(20).wanted).toEqual([[1, 1]]);
    expect(within(39).wanted).toEqual([[1, 2]]);
    expect(within(100).wanted).toEqual([[1, 3]]);
    expect(within(120).wanted).toEqual([[2, 1]]);
    expect(within(150).wanted).toEqual([[2, 3]]);
    expect(within(19)).toMatchObject({ wanted: [[1, 1]], status: "over budget" });
  });

  test("are at most a segment from the best", () => {
    const dice = seeded(9);
    for (let round = 0; round < 200; round++) {
      const cells = Array.from({ length: 3 }, () => {
        let [bytes, mean] = [0, 0];
        const steps = Array.from({ length: 4 }, () => {
          bytes += 1 + Math.floor(30 * dice());
          mean += 0.25 * dice();
          return [bytes, mean] as const;
        });
        return cell(
          steps.map(([b]) => b),
          steps.map(([, m]) => m),
          { share: 0.05 + dice() },
        );
      });
      const value = (levels: readonly number[]) =>
        levels.reduce((sum, k, i) => sum + (cells[i]?.share ?? 0) * (cells[i]?.mean[k - 1] ?? 0), 0);
      const bytes = cost([1, 1, 1], cells).bytes + 150 * dice();
      const budget = { ...NO_BUDGET, bytes };
      const { wanted } = planOf([{ cells, needed: 1 }], { mode: "budget", budget });
      let best = 0;
      for (let code = 0; code < 64; code++) {
        const levels = [1 + (code & 3), 1 + ((code >> 2) & 3), 1 + (code >> 4)];
        if (cost(levels, cells).bytes <= bytes) best = Math.max(best, value(levels));
      }
      const found = wanted.flat();
      expect(cost(found, cells).bytes).toBeLessThanOrEqual(bytes);
      const segments = cells.flatMap((c) =>
        hull(
          c.ladder.bytes,
          c.mean.map((m) => m * c.share),
        ),
      );
      expect(value(found)).toBeGreaterThanOrEqual(best - Math.max(0, ...segments.map(({ gain }) => gain)));
    }
  });

  test("keep earlier levels that are about as good", () => {
    const [a, b] = [cell([10, 20], [0.5, 0.9]), cell([10, 20], [0.5, 0.89])];
    const held = (previous: number[]) =>
      planOf([{ cells: [a, b].map((c, i) => ({ ...c, previous: previous[i] ?? 0 })), needed: 1 }], {
        mode: "budget",
        budget: { ...NO_BUDGET, bytes: 30 },
      }).wanted;
    expect(held([0, 0])).toEqual([[2, 1]]);
    expect(held([1, 2])).toEqual([[1, 2]]);
    expect(held([1, 1])).toEqual([[2, 1]]);
  });

  test("in several units at once are all kept, and well used", () => {
    const full = cost([5, 5, 5, 5]);
    for (let i = 0; i < 100; i++) {
      const part = () => 0.3 + 0.7 * random();
      const budget = {
        bytes: part() * full.bytes,
        gpuBytes: part() * full.gpuBytes,
        count: part() * full.count,
      };
      const { wanted, status } = plan({ mode: "budget", budget });
      expect(status).toBe("ok");
      const is = cost(wanted);
      for (const unit of ["bytes", "gpuBytes", "count"] as const) {
        expect(is[unit]).toBeLessThanOrEqual(budget[unit]);
      }
      expect(Math.max(...wanted)).toBeGreaterThan(1);
    }
  });

  test("nothing fits: the smallest of everything", () => {
    for (const unit of ["bytes", "gpuBytes", "count"]) {
      const budget = { ...NO_BUDGET, [unit]: 0 };
      for (const mode of ["target", "budget", "full", "base"] as const) {
        expect(plan({ mode, budget })).toEqual({ wanted: [1, 1, 1, 1], status: "over budget" });
      }
    }
  });

  test("leave out cells out of sight first, of least apparent size", () => {
    const seen = cell([10, 20], [0.5, 0.9]);
    const behind = (potential: number) => ({ ...seen, visible: false, share: 0, potential });
    const cells = [behind(0.2), seen, behind(0.3), behind(0.1)];
    const within = (bytes: number) => planOf([{ cells, needed: 0.5 }], { budget: { ...NO_BUDGET, bytes } });
    expect(within(40)).toMatchObject({ wanted: [[1, 1, 1, 1]], status: "ok" });
    expect(within(25)).toMatchObject({ wanted: [[0, 1, 1, 0]], status: "ok" });
    expect(within(9)).toMatchObject({ wanted: [[0, 1, 0, 0]], status: "over budget" });
  });

  test("a target beyond the budget becomes the best within it", () => {
    const budget = { ...NO_BUDGET, count: cost([5, 5, 5, 5]).count - 1 };
    const { wanted, status } = plan({ target: 0.8, budget });
    expect(status).toBe("infeasible");
    expect(cost(wanted).count).toBeLessThanOrEqual(budget.count);
  });
});

test("around the view cells are raised, the largest first, a segment at a time", () => {
  const seen = cell([10, 20], [0.5, 0.9]);
  const behind = (potential: number) => ({
    ...cell([10, 20, 40], [0.5, 0.8, 0.9]),
    visible: false,
    share: 0,
    potential,
  });
  const groups = [{ cells: [seen, behind(0.1), behind(0.3), behind(0.2)], needed: 0.5 }];
  const around = (aroundBytes: number, more: Partial<Settings> = {}) =>
    planOf(groups, { aroundBytes, ...more }).around[0];
  expect(planOf(groups, { aroundBytes: 100 }).wanted).toEqual([[1, 1, 1, 1]]);
  expect(around(0)).toEqual([1, 1, 1, 1]);
  expect(around(10)).toEqual([1, 1, 2, 1]);
  expect(around(29)).toEqual([1, 1, 2, 2]);
  expect(around(30)).toEqual([1, 2, 2, 2]);
  expect(around(50)).toEqual([1, 2, 3, 2]);
  expect(around(1000)).toEqual([1, 3, 3, 3]);
  expect(around(1000, { budget: { ...NO_BUDGET, count: 55 } })).toEqual([1, 1, 2, 1]);
  expect(around(1000, { mode: "base" })).toEqual([1, 1, 1, 1]);
});

test("a target of ssim takes the cheapest levels whose bound reaches it", () => {
  expect(plan({ target: 0.55 })).toEqual({ wanted: [2, 2, 2, 2], status: "ok" });
  expect(plan({ target: 0.9 })).toEqual({ wanted: [5, 5, 5, 5], status: "infeasible" });
  expect(plan({ target: 0.7 }, [{ visible: false }, { weight: 0 }])).toEqual({
    wanted: [1, 1, 4, 4],
    status: "ok",
  });
});

test("labels of fewer levels, and of unknown quality, are filled like the others or stay", () => {
  const q = [
    [0.5, 0.6, 0.95],
    [0.5, 0.9],
    [0.1, Number.NaN, 0.3],
  ];
  const c = [
    [10, 100, 1000],
    [10, 20, Infinity],
    [1, 2, 3],
  ];
  expect(fill([2, 0, 0], q, c, [1, 100, 1])).toEqual([2, 1, 0]);
  expect(fill([2, 0, 0], q, c, [1, 0, 1])).toEqual([2, 0, 0]);
  expect(fill([0, 0, 0], q, c, [1, 1, 1])).toEqual([0, 0, 0]); // equal levels already
  expect(fill([], [], [], [])).toEqual([]);
});

test("segments fall, and of equal ones those of the lower row come first", () => {
  const order: number[][] = [];
  const row = [1, 2, 4];
  climb(
    [row, row, [1, 2, 3]],
    [
      [0, 1, 2],
      [0, 1, 2],
      [0, 0.1, 0.2],
    ],
    [0, 0, 0],
    (segment) => {
      order.push([segment.row, segment.from, segment.to]);
      return segment.row < 2;
    },
  );
  expect(order).toEqual([
    [0, 0, 1],
    [1, 0, 1],
    [0, 1, 2],
    [1, 1, 2],
    [2, 0, 1], // not taken: the row stays
  ]);
  expect(hull([1, 2, 3], [0, 0.1, 1])).toMatchObject([{ from: 0, to: 2 }]);
  expect(nextSegment([1, 1], [0, 1], 0)).toMatchObject({ to: 1, slope: Infinity });
  expect(nextSegment([1, 2], [1, 1], 0)).toBeNull();
});

test("broken increments cap a cell, and one without any level is left out", () => {
  expect(plan({ mode: "full" }, [{ highest: 3 }, { highest: 0 }])).toEqual({
    wanted: [3, 0, 5, 5],
    status: "ok",
  });
  expect(plan({ target: 0.75 }, [{ highest: 3 }])).toEqual({ wanted: [3, 4, 4, 4], status: "infeasible" });
});

test("nothing to plan", () => {
  expect(makePlan([], DEFAULTS)).toEqual({ wanted: [], around: [], status: "ok" });
});

test("a level is not left for less than the slack", () => {
  const bound = [[0.3, 0.556, 0.6, 0.7, 0.8]];
  expect(plan({ target: 0.55 }, [{ previous: 3 }], bound).wanted[0]).toBe(3);
  expect(plan({ target: 0.55 }, [], bound).wanted[0]).toBe(2);
  expect(plan({ target: 0.54 }, [{ previous: 3 }], bound).wanted[0]).toBe(2);
});
