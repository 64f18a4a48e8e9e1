import { expect, test } from "vitest";
import { formatLook, formatName, formatScreens } from "../../src/ui/format";

test("promises name the screens that they are for", () => {
  const known = "Promises are for screens of 0.5 to 2 times the photos' sharpness";
  const screens = { least: 0.5, most: 2, here: 1.2 };
  expect(formatScreens(screens, 900)).toBe(known);
  expect(formatScreens({ ...screens, here: 2 }, 900)).toBe(known);
  expect(formatScreens({ ...screens, here: 3 }, 1800)).toBe(`${known}; compared as averaged down to 1200 px`);
  expect(formatScreens({ ...screens, fov: 100 }, 900)).toBe(`${known} and lenses up to 100°`);
  const photos = { least: 1, most: 1, here: 0.4 };
  expect(formatScreens(photos, 900)).toBe("Promises are for screens as sharp as the photos");
  expect(formatScreens({ ...photos, here: 1.5 }, 900)).toContain("averaged down to 600 px");
  expect(formatScreens({ ...photos, least: 1.5, most: 1.5 }, 900)).toContain("screens of 1.5 times");
});

test("files' names are no titles", () => {
  expect(formatName("guitar.compressed.ply")).toBe("Guitar");
  expect(formatName("town_hall")).toBe("Town hall");
  expect(formatName("v1.2")).toBe("V1.2");
  expect(formatName(".ply")).toBe(".ply");
});

test("a fidelity is said in words, of SSIM against photos nothing is", () => {
  const looks = [0.7, 0.8, 0.9, 0.95, 0.98].map((target) => formatLook("fidelity", target));
  expect(new Set(looks).size).toBe(5);
  expect(formatLook("ssim", 0.9)).toBe("");
});

test("an adopted scene has viewpoints, and no photos", () => {
  expect(formatScreens({ least: 0.5, most: 2, here: 1, fov: 90 }, 900, "viewpoints")).toBe(
    "Promises are for screens of 0.5 to 2 times the viewpoints' sharpness and lenses up to 90°",
  );
});
