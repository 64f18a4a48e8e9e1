/** Brings a PLY file of splats (INRIA's layout) from the capture's axes into the bundle's: y and z negated. */

const HEADER = 2 ** 20; // bytes in which the header must end
const SIZES: Readonly<Record<string, number>> = { char: 1, uchar: 1, short: 2, ushort: 2, int: 4, uint: 4 };

/** Whether a spherical harmonic changes its sign with y and z, by its place in 3DGS's order. */
const ODD = [1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0].map(Boolean);

/** A copy in the other axes; throws for a file that is no binary PLY of splats. Exact: only signs change. */
export function flipped(bytes: Uint8Array): Uint8Array {
  const { start, stride, count, floats } = layoutOf(bytes);
  if (!(count > 0) || bytes.length < start + count * stride) throw new Error("a PLY file that ends early");
  const out = bytes.slice();
  const bases = [...floats.keys()].filter((name) => name.startsWith("f_rest_")).length / 3;
  for (const [name, offset] of floats) {
    if (!changes(name, bases)) continue;
    // of a little-endian float the sign is the highest bit of the last byte
    for (let at = start + offset + 3, i = 0; i < count; i++, at += stride) out[at] = (out[at] ?? 0) ^ 0x80;
  }
  return out;
}

function changes(name: string, bases: number): boolean {
  if (name.startsWith("f_rest_")) return ODD[Number(name.slice(7)) % bases] ?? false; // all red, green, blue
  return name === "y" || name === "z" || name === "rot_2" || name === "rot_3"; // rotations are w x y z
}

/** Where the splats are: offset of the first, bytes of each, and the offsets of float properties in them. */
function layoutOf(bytes: Uint8Array) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, HEADER));
  const end = text.indexOf("end_header\n");
  const lines = text.slice(0, Math.max(end, 0)).split("\n");
  const floats = new Map<string, number>();
  let stride = 0;
  let count = Number.NaN;
  for (const line of lines) {
    const [word = "", type = "", name = ""] = line.split(" ");
    if (word === "element") count = type === "vertex" ? Number(name) : Number.NaN;
    if (word !== "property") continue;
    if (type === "float") floats.set(name, stride);
    stride += type === "float" ? 4 : (SIZES[type] ?? Number.NaN);
  }
  if (!lines.includes("format binary_little_endian 1.0") || Number.isNaN(stride)) {
    throw new Error("not a binary PLY file");
  }
  return { start: end + "end_header\n".length, stride, count, floats };
}
