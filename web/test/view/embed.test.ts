import { expect, test } from "vitest";
import { parseOptions } from "../../src/embed";
import { formatBytes, formatCount, formatDistance, formatSsim } from "../../src/ui/format";
import { dead } from "../../src/view/controls";

test("options come from the query and the fragment", () => {
  const options = parseOptions("?target=0.8&ui=0", "#view=a b.jpg&budget=1.5");
  expect(options).toEqual({ view: "a b.jpg", target: 0.8, budget: 1.5, ui: false, bundle: "" });
  expect(parseOptions("", "").ui).toBe(true);
});

test.each([
  "..",
  "../a",
  "a/../b",
  "/a",
  "//host/a",
  "https://host/",
  "data:x",
  "a\\b",
  "%2e%2e/",
  "%252e%252e%2f..",
  "a?b",
  "%",
])("a bundle at %s is refused", (path) => {
  expect(() => parseOptions(`?bundle=${encodeURIComponent(path)}`, "")).toThrow(/below it/);
});

test("a bundle below the page gets its slash", () => {
  expect(parseOptions("?bundle=scenes/garden", "").bundle).toBe("scenes/garden/");
  expect(parseOptions("?bundle=garden/", "").bundle).toBe("garden/");
});

test.each(["2", "-1", "", "x", "NaN"])("a target of %s is refused", (value) => {
  expect(() => parseOptions(`?target=${value}`, "")).toThrow(/from 0 to 1/);
});

test("numbers for people", () => {
  expect([0, 999, 1234, 123_456, 1.9e6, 250e6, Infinity].map(formatBytes)).toEqual([
    "0 B",
    "999 B",
    "1.2 kB",
    "123 kB",
    "1.90 MB",
    "250 MB",
    "no limit",
  ]);
  expect([12, 1234, 91_972, 1.25e6].map(formatCount)).toEqual(["12", "1.2 k", "92 k", "1.25 M"]);
  expect([Number.NaN, 1.24, 38].map(formatDistance)).toEqual(["–", "1.2 m", "38 m"]);
  expect([0.834, Number.NaN].map(formatSsim)).toEqual(["0.83", "–"]);
});

test("a stick at rest is at rest, and reaches its end", () => {
  expect(dead(0.1)).toBe(0);
  expect(dead(-1)).toBe(-1);
});
