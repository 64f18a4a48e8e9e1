/** Plans: modes, several budgets at once, what is always shipped, what nobody sees. */

import { expect, test } from "vitest";
import { fill } from "../../src/core/fill";
import { type Candidate, ladderOf, makePlan } from "../../src/core/planner";
import type { Settings } from "../../src/types";
import { Network, seeded, VirtualClock } from "../simulate";
import { bundle, DEFAULTS, NO_BUDGET, totals } from "../worlds";

const random = seeded(3);
const { labels } = bundle(new Network(new VirtualClock()), { labels: 4, levels: 5, bytes: 900 });
// counts and bytes that do not go together, so that both budgets matter
const odd = labels.map((label) => ({
  ...label,
  levels: label.levels.map((level) => ({ ...level, count: 1 + Math.floor(100 * random()) })),
}));

const candidates = (changes: Partial<Candidate>[] = []): Candidate[] =>
  odd.map((label, i) => ({
    label,
    ladder: ladderOf(label),
    highest: 5,
    mean: [0.4, 0.6, 0.7, 0.8, 0.85],
    bound: [0.35, 0.55, 0.65, 0.75, 0.8],
    weight: 1,
    share: 0.1 * (i + 1),
    visible: true,
    previous: 0,
    ...changes[i],
  }));
const settings = (partial: Partial<Settings>): Settings => ({ ...DEFAULTS, quality: "ssim", ...partial });
const plan = (partial: Partial<Settings>, changes: Partial<Candidate>[] = []) =>
  makePlan(candidates(changes), settings(partial));

/** What a plan costs in all units. */
const cost = (wanted: readonly number[]) =>
  totals(odd.map((label, i) => ({ ...label, levels: label.levels.slice(0, wanted[i]) })));

test("a target takes the cheapest levels whose bound reaches it", () => {
  expect(plan({ target: 0.55 })).toEqual({ wanted: [2, 2, 2, 2], status: "ok" });
  expect(plan({ target: 0.9 })).toEqual({ wanted: [5, 5, 5, 5], status: "infeasible" });
  expect(plan({ target: 0.7 }, [{ visible: false }, { weight: 0 }])).toEqual({
    wanted: [1, 1, 4, 4],
    status: "ok",
  });
});

test("of fidelity, a picture below equal levels gets the upgrades of most gain per byte", () => {
  // one hard category that is small, and one that is large and easy
  const hard: Partial<Candidate> = { share: 0.01, bound: [0.1, 0.2, 0.3, 0.5, 0.97] };
  const easy: Partial<Candidate> = { share: 0.9, bound: [0.95, 0.96, 0.97, 0.98, 0.99] };
  const changes = [hard, easy, easy, easy];
  const asked = { target: 0.95 } as const;
  expect(plan({ ...asked, quality: "ssim" }, changes).wanted).toEqual([5, 1, 1, 1]);
  const { wanted, status } = plan({ ...asked, quality: "fidelity" }, changes);
  expect(status).toBe("ok");
  expect(wanted[0]).toBe(5);
  expect(Math.max(...wanted.slice(1))).toBeGreaterThan(1);
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

test("broken increments cap a label, and one without any level is left out", () => {
  expect(plan({ mode: "full" }, [{ highest: 3 }, { highest: 0 }])).toEqual({
    wanted: [3, 0, 5, 5],
    status: "ok",
  });
  expect(plan({ target: 0.75 }, [{ highest: 3 }])).toEqual({ wanted: [3, 4, 4, 4], status: "infeasible" });
});

test("budgets in several units at once are all kept, and well used", () => {
  const full = cost([5, 5, 5, 5]);
  let joint = 0;
  for (let i = 0; i < 200; i++) {
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
    if (wanted.some((level) => level > 1)) joint += 1;
  }
  expect(joint).toBe(200);
});

test("nothing fits: the smallest of everything", () => {
  for (const unit of ["bytes", "gpuBytes", "count"]) {
    const budget = { ...NO_BUDGET, [unit]: 0 };
    for (const mode of ["target", "budget", "full", "base"] as const) {
      expect(plan({ mode, budget })).toEqual({ wanted: [1, 1, 1, 1], status: "over budget" });
    }
  }
});

test("a target beyond the budget becomes the best within it", () => {
  const budget = { ...NO_BUDGET, count: cost([5, 5, 5, 5]).count - 1 };
  const { wanted, status } = plan({ target: 0.8, budget });
  expect(status).toBe("infeasible");
  expect(cost(wanted).count).toBeLessThanOrEqual(budget.count);
});

test("nothing to plan", () => {
  expect(makePlan([], DEFAULTS)).toEqual({ wanted: [], status: "ok" });
});

test("a level is not left for less than the slack", () => {
  const near = [{ bound: [0.3, 0.556, 0.6, 0.7, 0.8], previous: 3 }];
  expect(plan({ target: 0.55 }, near).wanted[0]).toBe(3);
  expect(plan({ target: 0.55 }, [{ ...near[0], previous: 0 }]).wanted[0]).toBe(2);
  expect(plan({ target: 0.54 }, near).wanted[0]).toBe(2);
});
