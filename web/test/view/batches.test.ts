import { readFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { expect, test } from "vitest";
import { batched } from "../../src/view/batches";

const SPARK = readFileSync(fileURLToPath(import.meta.resolve("@sparkjsdev/spark")), "utf8");
const VERTEX: string = JSON.parse(SPARK.match(/var splatVertex_default = (".*");/)?.[1] ?? '""');

test("splats are read by batch, and fitted once their alpha is known", () => {
  const shader = batched(VERTEX);
  expect(shader).not.toMatch(/gl_InstanceID (?!\*)/);
  const fitted = shader.indexOf("log(rgba.a / minAlpha)");
  expect(fitted).toBeGreaterThan(shader.indexOf("rgba.a *= blurAdjust"));
  expect(fitted).toBeLessThan(shader.indexOf("float scale1"));
  expect(shader).toContain("clamp(viewCenter.xy * invZ, -(shift + 1.3) / lens, (1.3 - shift) / lens)");
  expect(shader.indexOf("vSplatUv = position.xy * vec2(scale1")).toBeGreaterThan(fitted);
});

test("a shader of another version is refused", () => {
  expect(() => batched("void main() {}")).toThrow("not the shader of Spark 2.2");
});
