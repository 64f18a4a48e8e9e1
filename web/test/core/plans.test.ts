/** The vectors that every implementation of the planner shares. */

import { expect, test } from "vitest";
import vectors from "../../../tests/data/plans.json?raw";
import { bestWithin, cheapest, type Options } from "../../src/core/allocate";
import { fill } from "../../src/core/fill";
import type { Table } from "../../src/core/knapsack";

type Row = (number | null)[];
interface Case {
  name: string;
  mode: "target" | "budget" | "fill";
  quality: Row[] | Row[][];
  cost: Row[];
  target?: number | number[];
  budget?: number;
  weight?: number[] | number[][];
  previous?: number[];
  levels?: number[]; // that upgrades are added to
  slack?: number;
  states?: number;
  expected: Record<string, unknown>;
}

const isWalk = (quality: Case["quality"]): quality is Row[][] => Array.isArray(quality[0]?.[0]);
const filled = (rows: Row[], instead: number): Table => rows.map((row) => row.map((v) => v ?? instead));

function planned(c: Case, quality: Row[], weight: number[], previous?: number[]) {
  const options: Options = {
    weight,
    ...(previous && { previous }),
    ...(c.slack !== undefined && { slack: c.slack }),
    ...(c.states !== undefined && { states: c.states }),
  };
  const [q, costs] = [filled(quality, Number.NaN), filled(c.cost, Infinity)];
  if (c.mode === "target") return cheapest(q, costs, c.target ?? Number.NaN, options);
  return bestWithin(q, costs, weight, c.budget ?? Number.NaN, options);
}

(JSON.parse(vectors) as Case[]).forEach((c, i) => {
  test(`${i}: ${c.name}, ${c.mode}`, () => {
    const ones = c.cost.map(() => 1);
    if (c.mode === "fill") {
      const tables = [filled(c.quality as Row[], Number.NaN), filled(c.cost, Infinity)] as const;
      return expect({ levels: fill(c.levels ?? [], ...tables, c.weight as number[]) }).toEqual(c.expected);
    }
    if (isWalk(c.quality)) {
      let levels: number[] | undefined;
      const walk = c.quality.map((quality, p) => {
        const weight = Array.isArray(c.weight?.[0]) ? (c.weight as number[][])[p] : (c.weight as number[]);
        levels = planned(c, quality, weight ?? ones, levels).levels;
        return levels;
      });
      return expect({ levels: walk }).toEqual(c.expected);
    }
    const { value, bound, ...exact } = planned(c, c.quality, (c.weight as number[]) ?? ones, c.previous);
    expect(c.expected).toMatchObject(exact);
    const worth = Number(c.expected.value);
    expect(Math.abs(value - worth)).toBeLessThanOrEqual(1e-9 * Math.abs(worth));
    const expected = Number(c.expected.bound);
    expect(Math.abs(bound - expected)).toBeLessThanOrEqual(1e-9 * Math.abs(expected));
  });
});
