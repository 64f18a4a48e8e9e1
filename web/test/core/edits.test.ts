import { describe, expect, it } from "vitest";
import { Edits, type Origin, runsOf } from "../../src/core/edits";

const LADDER = "a".repeat(64);
const origin = (id: number, name: string, count: number, parent?: string): Origin => ({
  id,
  name,
  title: name,
  count,
  weight: 1,
  always: false,
  hidden: false,
  ...(parent === undefined ? {} : { parent }),
});
const ORIGINS = [origin(1, "chair 1", 5, "chair"), origin(2, "chair 2", 3, "chair"), origin(3, "grass", 4)];
const made = () => new Edits(ORIGINS, LADDER);
const names = ({ categories }: Edits) => categories.present.map((i) => categories.list[i]?.name);

describe("edits", () => {
  it("rename, merge and split, with undo and redo", () => {
    const edits = made();
    edits.apply({ op: "rename", category: "grass", to: "lawn" });
    edits.apply({ op: "merge", category: "chair 2", into: "chair 1" });
    edits.apply({
      op: "split",
      category: "chair 1",
      to: "leg",
      gaussians: { "chair 1": [0, 2], "chair 2": [1, 1] },
    });
    expect(names(edits)).toEqual(["chair 1", "lawn", "leg"]);
    expect(edits.categories.counts()).toEqual([5, 0, 4, 3]);
    edits.undo();
    expect(names(edits)).toEqual(["chair 1", "lawn"]);
    edits.redo();
    expect(names(edits)).toEqual(["chair 1", "lawn", "leg"]);
    for (let i = 0; i < 4; i++) edits.undo();
    expect(names(edits)).toEqual(["chair 1", "chair 2", "grass"]);
    expect(edits.canUndo).toBe(false);
  });

  it("is saved and read back", () => {
    const edits = made();
    edits.apply({ op: "hide", category: "grass", hidden: true });
    edits.apply({ op: "weigh", category: "grass", weight: 2 });
    edits.apply({ op: "full", category: "chair 1", always: true });
    const again = made();
    again.load(edits.dump());
    expect(again.dump()).toBe(edits.dump());
    expect(again.categories.list[2]).toMatchObject({ hidden: true, weight: 2 });
    expect(JSON.parse(edits.dump())).toMatchObject({
      format: "sagesplat-label-edits",
      version: 1,
      ladder: LADDER,
    });
  });

  it.each([
    ["a name that is taken", { op: "rename", category: "grass", to: "chair 1" }, "taken"],
    ["a name of control characters", { op: "rename", category: "grass", to: "a\u0000" }, "invisible"],
    ["the name of what has none", { op: "rename", category: "grass", to: "unlabelled" }, "taken"],
    ["an unknown category", { op: "hide", category: "gras", hidden: true }, "no category gras"],
    ["a merge with itself", { op: "merge", category: "grass", into: "grass" }, "itself"],
    ["an empty selection", { op: "split", category: "grass", to: "x", gaussians: {} }, "Nothing is selected"],
    [
      "ranks that there are not",
      { op: "split", category: "grass", to: "x", gaussians: { grass: [3, 2] } },
      "Ranks",
    ],
    [
      "all of it",
      { op: "split", category: "grass", to: "x", gaussians: { grass: [0, 4] } },
      "Nothing would be left",
    ],
    [
      "another category's",
      { op: "split", category: "grass", to: "x", gaussians: { "chair 1": [0, 1] } },
      "another",
    ],
    ["a weight below 0", { op: "weigh", category: "grass", weight: -1 }, "weight"],
  ] as const)("refuses %s and changes nothing", (_, operation, why) => {
    const edits = made();
    expect(() => edits.apply(operation)).toThrow(why);
    expect(edits.operations).toEqual([]);
    expect(edits.categories.counts()).toEqual([5, 3, 4]);
  });

  it.each([
    ["{", "Not a file"],
    ["[]", "Not a file"],
    [JSON.stringify({ format: "sagesplat-label-edits", version: 2 }), "version 2"],
    [JSON.stringify({ format: "sagesplat-label-edits", version: 1, ladder: "b".repeat(64) }), "another run"],
    [
      JSON.stringify({
        format: "sagesplat-label-edits",
        version: 1,
        ladder: LADDER,
        operations: [{ op: "toString" }],
      }),
      "Damaged",
    ],
  ])("refuses %s", (json, why) => {
    expect(() => made().load(json)).toThrow(why);
  });
});

describe("runs", () => {
  it("are first ranks and numbers", () => {
    expect(runsOf(Uint8Array.of(1, 1, 0, 1, 0, 0, 1))).toEqual([0, 2, 3, 1, 6, 1]);
    expect(runsOf(new Uint8Array(3))).toEqual([]);
  });
});
