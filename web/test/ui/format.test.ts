import { expect, test } from "vitest";
import { formatScreens } from "../../src/ui/format";

test("promises name the screens that they are for", () => {
  const known = "Promises are for screens of 0.5 to 2 times the photos' sharpness";
  const screens = { least: 0.5, most: 2, here: 1.2 };
  expect(formatScreens(screens, 900)).toBe(known);
  expect(formatScreens({ ...screens, here: 2 }, 900)).toBe(known);
  expect(formatScreens({ ...screens, here: 3 }, 1800)).toBe(`${known}; compared as averaged down to 1200 px`);
  const photos = { least: 1, most: 1, here: 0.4 };
  expect(formatScreens(photos, 900)).toBe("Promises are for screens as sharp as the photos");
  expect(formatScreens({ ...photos, here: 1.5 }, 900)).toContain("averaged down to 600 px");
  expect(formatScreens({ ...photos, least: 1.5, most: 1.5 }, 900)).toContain("screens of 1.5 times");
});
