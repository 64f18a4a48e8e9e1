/** A PLY file in the bundle's axes. */

import { expect, test } from "vitest";
import { flipped } from "../../src/view/ply";

const REST = Array.from({ length: 9 }, (_, i) => `f_rest_${i}`);
const FLOATS = ["x", "y", "z", "nx", "f_dc_0", ...REST, "opacity", "rot_0", "rot_1", "rot_2", "rot_3"];

/** A file of splats of degree 1 whose values are all 1, and a label after each. */
function ply(count: number, { format = "binary_little_endian", announced = count } = {}): Uint8Array {
  const properties = FLOATS.map((name) => `property float ${name}\n`).join("");
  const header = `ply\nformat ${format} 1.0\ncomment label 1 a b\nelement vertex ${announced}\n${properties}property short label\nend_header\n`;
  const head = new TextEncoder().encode(header);
  const stride = 4 * FLOATS.length + 2;
  const out = new Uint8Array(head.length + count * stride);
  out.set(head);
  const view = new DataView(out.buffer);
  for (let i = 0; i < count; i++) {
    const start = head.length + i * stride;
    for (let k = 0; k < FLOATS.length; k++) view.setFloat32(start + 4 * k, 1, true);
    view.setInt16(start + 4 * FLOATS.length, 7, true);
  }
  return out;
}

test("only the signs of what changes with y and z change", () => {
  const before = ply(3);
  const after = flipped(before);
  expect(before).toEqual(ply(3)); // it may be kept for another time
  const view = new DataView(after.buffer);
  const stride = 4 * FLOATS.length + 2;
  const start = after.length - 3 * stride;
  for (const i of [0, 2]) {
    const negative = FLOATS.filter((_, k) => view.getFloat32(start + i * stride + 4 * k, true) === -1);
    const odd = ["f_rest_0", "f_rest_1", "f_rest_3", "f_rest_4", "f_rest_6", "f_rest_7"]; // y z of y z x
    expect(negative).toEqual(["y", "z", ...odd, "rot_2", "rot_3"]);
    expect(view.getInt16(start + (i + 1) * stride - 2, true)).toBe(7);
  }
  expect(flipped(after)).toEqual(before);
});

test("other files are refused", () => {
  expect(() => flipped(ply(2, { announced: 3 }))).toThrow("ends early");
  expect(() => flipped(ply(0))).toThrow("ends early");
  expect(() => flipped(ply(2, { format: "ascii" }))).toThrow("not a binary PLY file");
  expect(() => flipped(new Uint8Array(100))).toThrow("not a binary PLY file");
});
