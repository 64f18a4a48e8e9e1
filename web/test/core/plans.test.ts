/** The vectors that every implementation of the planner shares. */

import { expect, test } from "vitest";
import vectors from "../../../tests/data/plans.json?raw";
import { cheapest, type Options, type Table, together } from "../../src/core/allocate";
import { fill } from "../../src/core/fill";

type Row = (number | null)[];
interface Case {
  name: string;
  mode: "target" | "fill";
  quality: Row[] | Row[][];
  cost: Row[];
  target?: number | number[];
  weight?: number[];
  previous?: number[];
  levels?: number[]; // that upgrades are added to
  slack?: number;
  expected: { levels: unknown; status?: string; missed?: boolean[] };
}
interface CellsCase {
  name: string;
  mode: "cells";
  labels: {
    cells: { cost: number[]; mean: number[]; share: number; visible: boolean }[];
    weight: number;
    theta: number | null;
  }[];
  expected: { levels: number[][] };
}

const isWalk = (quality: Case["quality"]): quality is Row[][] => Array.isArray(quality[0]?.[0]);
const filled = (rows: Row[], instead: number): Table => rows.map((row) => row.map((v) => v ?? instead));

function planned(c: Case, quality: Row[], previous?: number[]) {
  const options: Options = {
    ...(previous && { previous }),
    ...(c.slack !== undefined && { slack: c.slack }),
  };
  return cheapest(filled(quality, Number.NaN), filled(c.cost, Infinity), c.target ?? Number.NaN, options);
}

const all = JSON.parse(vectors) as (Case | CellsCase)[];
const withCells = all.filter((c): c is CellsCase => c.mode === "cells");
const others = all.filter((c): c is Case => c.mode === "target" || c.mode === "fill");

others.forEach((c, i) => {
  test(`${i}: ${c.name}, ${c.mode}`, () => {
    if (c.mode === "fill") {
      const tables = [filled(c.quality as Row[], Number.NaN), filled(c.cost, Infinity)] as const;
      return expect({ levels: fill(c.levels ?? [], ...tables, c.weight as number[]) }).toEqual(c.expected);
    }
    if (isWalk(c.quality)) {
      let levels: number[] | undefined;
      const walk = c.quality.map((quality) => {
        levels = planned(c, quality, levels).levels;
        return levels;
      });
      return expect({ levels: walk }).toEqual(c.expected);
    }
    expect(c.expected).toMatchObject(planned(c, c.quality, c.previous));
  });
});

test("cells of labels that reach a mean together", () => {
  expect(withCells).not.toHaveLength(0);
  for (const { name, labels, expected } of withCells) {
    const levels = labels.map(({ cells, weight, theta }) => {
      const seen = cells.filter(({ visible }) => visible && weight > 0);
      const found = together(
        {
          cost: seen.map(({ cost }) => cost),
          mean: seen.map(({ mean }) => mean),
          share: seen.map(({ share }) => share),
        },
        theta ?? 1,
      ).levels;
      return cells.map((cell) => found[seen.indexOf(cell)] ?? 0);
    });
    expect(levels, name).toEqual(expected.levels);
  }
});
