import { expect, test } from "vitest";
import { bundleUrl, linkTo, parseOptions } from "../../src/embed";
import type { Settings } from "../../src/types";
import { formatBytes, formatCount, formatDistance, formatSsim } from "../../src/ui/format";
import { dead } from "../../src/view/controls";

test("options come from the query and the fragment", () => {
  const options = parseOptions("?target=0.8&ui=0", "#view=a b.jpg&budget=1.5");
  expect(options).toEqual({
    view: "a b.jpg",
    pose: null,
    quality: null,
    target: 0.8,
    budget: 1.5,
    ui: false,
    bundle: "",
    edit: null,
  });
  expect(parseOptions("", "").ui).toBe(true);
  expect(parseOptions("?quality=ssim&target=0.7", "")).toMatchObject({ quality: "ssim", target: 0.7 });
  expect(() => parseOptions("?quality=psnr", "")).toThrow("?quality=psnr is not one of fidelity, ssim");
});

test("a link shows the same again", () => {
  const pose = { position: [1, -2.5, 1 / 3], quaternion: [0, 0.6, 0, 0.8], fovY: 1 } as const;
  const unlimited = { bytes: Infinity, gpuBytes: Infinity, count: Infinity };
  const settings = { mode: "target", quality: "fidelity", target: 0.85, budget: unlimited } as Settings;
  const page = "https://a.b/c/?bundle=garden/&view=old.jpg&edit=secret#target=0.5&ui=0";
  const link = linkTo(page, pose, settings);
  expect(link).toBe(
    "https://a.b/c/?bundle=garden%2F&ui=0&pose=1,-2.5,0.333333,0,0.6,0,0.8&quality=fidelity&target=0.85",
  );
  const { search, hash } = new URL(link);
  expect(parseOptions(search, hash)).toMatchObject({
    view: null,
    pose: { position: [1, -2.5, 0.333333], quaternion: [0, 0.6, 0, 0.8] },
    target: 0.85,
    bundle: "garden/",
    ui: false,
    edit: null,
  });
  const budget = linkTo(page, pose, { ...settings, mode: "budget", budget: { ...unlimited, bytes: 2.5e5 } });
  expect(parseOptions(new URL(budget).search, "")).toMatchObject({ budget: 0.25, target: null });
  for (const bad of ["1,2,3", "1,2,3,0,0,0,0", "a,2,3,0,0,0,1", ",,,,,,", "1,2,3,0,0,0,1,1"]) {
    expect(() => parseOptions(`?pose=${bad}`, "")).toThrow("is not seven numbers");
  }
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
  "a#b",
  "%",
  "%2e%2e%2f",
  ".%2e/",
  "%2E./",
  "garden/%2e%2e/%2e%2e/",
  "%25252e%25252e/",
  "%252525252525252e/",
  "%5c%5chost/",
  "..%5c",
  "\\\\host",
  "/\\host",
  "%2f%2fhost/",
  "%252f%252fhost/",
  "a/%00/",
  "\t/host",
  "/\n/host",
  ".\t./",
  "a%0a/../..",
  "javascript:x",
  "blob:x",
  ":80/",
])("a bundle at %s is refused", (path) => {
  expect(() => parseOptions(`?bundle=${encodeURIComponent(path)}`, "")).toThrow(/below it/);
});

test("the address of a bundle is below the page's", () => {
  const page = "https://host/site/page.html?bundle=x#y";
  expect(bundleUrl("scenes/garden/", page).href).toBe("https://host/site/scenes/garden/");
  expect(bundleUrl("", page).href).toBe("https://host/site/");
  expect(bundleUrl("50% off".replace("%", "%25"), "https://host/").href).toBe("https://host/50%25%20off");
  for (const folder of ["../", "%2e%2e/", "a/.%2e/%2E%2e/", "..\\", ".\t./"]) {
    expect(() => bundleUrl(folder, page)).toThrow(/leaves this page's folder/);
  }
});

test("a bundle below the page gets its slash", () => {
  expect(parseOptions("?bundle=scenes/garden", "").bundle).toBe("scenes/garden/");
  expect(parseOptions("?bundle=garden/", "").bundle).toBe("garden/");
  for (const name of ["a..b", "...", "größe", "a b", ".hidden"]) {
    expect(parseOptions(`?bundle=${encodeURIComponent(name)}`, "").bundle).toBe(`${name}/`);
  }
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
