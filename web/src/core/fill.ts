/**
 * Upgrades after the cheapest levels, where those lie below equal levels of the same bytes. The rule is
 * documented in src/sagesplat/adapt/fill.py; tests/data/plans.json (mode "fill") checks both.
 */

import type { Table } from "./allocate";
import { climb, type Segment } from "./hull";

const SLACK = 0.004;

/**
 * Adds upgrades until the composition is hardly worse than equal levels of the same cost.
 *
 * @param levels - from 0, the least that each row, a cell or label, gets
 * @param quality - mean quality by row and level, never falling; NaN: unknown, the row stays
 * @param cost - Infinity for an unavailable level, above all others; such levels count as the last one there is
 * @param weight - 0: the row stays
 * @returns a level per row
 */
export function fill(
  levels: readonly number[],
  quality: Table,
  cost: Table,
  weight: readonly number[],
): number[] {
  const last = Math.max(0, ...cost.map((row) => row.length));
  const rows = cost.map((costs, label) => available(quality[label] ?? [], costs, weight[label] ?? 0));
  const total = rows.reduce((sum, row) => sum + row.weight, 0);
  const found = [...levels];
  if (total === 0) return found;
  const uniform = Array.from({ length: last }, (_, k) =>
    totals(
      rows,
      rows.map(() => k),
    ),
  );
  let { bytes, value } = totals(rows, found);
  if (reached(bytes, value, uniform, total)) return found;
  let isDone = false;
  const take = ({ row, to }: Segment) => {
    if (isDone) return false;
    const [{ cost, value: values }, before] = [rows[row] as Row, found[row] as number];
    bytes += at(cost, to) - at(cost, before);
    value += at(values, to) - at(values, before);
    found[row] = to;
    isDone = reached(bytes, value, uniform, total);
    return true;
  };
  climb(
    rows.map(({ cost }) => cost),
    rows.map(({ value }) => value),
    found,
    take,
  );
  return found;
}

interface Row {
  readonly cost: readonly number[]; // of the available levels
  readonly value: readonly number[]; // weight x quality
  readonly weight: number; // 0 where a quality is unknown
}

function available(quality: readonly number[], costs: readonly number[], weight: number): Row {
  const cost = costs.filter((c) => c < Infinity);
  const known = cost.every((_, k) => Number.isFinite(quality[k]));
  const counts = known ? weight : 0;
  return { cost, value: cost.map((_, k) => (counts > 0 ? counts * at(quality, k) : 0)), weight: counts };
}

/** Cost and value of a composition; a level above the last one of a label counts as that. */
function totals(rows: readonly Row[], levels: readonly number[]): { bytes: number; value: number } {
  let [bytes, value] = [0, 0];
  rows.forEach((row, label) => {
    const level = Math.min(levels[label] ?? 0, row.cost.length - 1);
    bytes += at(row.cost, level);
    value += at(row.value, level);
  });
  return { bytes, value };
}

/** Whether a composition is no worse than the uniform curve at its cost. */
function reached(
  bytes: number,
  value: number,
  uniform: readonly { bytes: number; value: number }[],
  total: number,
): boolean {
  const above = uniform.findIndex((point) => bytes <= point.bytes);
  const to = uniform[above < 0 ? uniform.length - 1 : above] as { bytes: number; value: number };
  const from = above > 0 ? uniform[above - 1] : undefined;
  const curve = from
    ? from.value + ((bytes - from.bytes) / (to.bytes - from.bytes)) * (to.value - from.value)
    : to.value;
  return value / total >= curve / total - SLACK;
}

const at = (values: readonly number[], i: number): number => values[i] as number;
