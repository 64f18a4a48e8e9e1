import { describe, expect, it } from "vitest";
import { checkedName } from "../../src/core/names";

describe("names", () => {
  it.each(["chair 1", "<b>bold</b> & co", "левая статуя", "椅子", "x".repeat(100), "é".normalize("NFD")])(
    "%s",
    (name) => {
      expect(checkedName(name)).toBe(name.normalize("NFC"));
    },
  );

  it.each([
    ["", "blank"],
    ["   ", "blank"],
    ["\u3164", "blank"],
    [" chair", "begins or ends"],
    ["x".repeat(101), "101 characters"],
    ["x".repeat(300), "300 characters"],
    ["a\u0007", "U+0007"],
    ["a\u202eb", "U+202E"],
    ["a\nb", "U+000A"],
  ])("%j is none", (name, why) => {
    expect(() => checkedName(name)).toThrow(why);
  });
});
