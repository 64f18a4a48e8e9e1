/** Checks of untrusted JSON: each reports all defects with their paths. */

/** A defect of a bundle, as one line for the user. */
export class BundleError extends Error {
  override name = "BundleError";
}

/** Appends the defects of a value at a path to `wrong`. */
export type Check = (value: unknown, path: string, wrong: string[]) => void;

type Fields = Readonly<Record<string, unknown>>;

const isObject = (value: unknown): value is Fields =>
  typeof value === "object" && value !== null && !Array.isArray(value);

/** A check with a description for messages: "labels[2].weight must be a number from 0 on". */
function must(be: string, holds: (value: unknown) => boolean): Check {
  return (value, path, wrong) => {
    if (value === undefined) wrong.push(`${path} is missing`);
    else if (!holds(value)) wrong.push(`${path} must be ${be}`);
  };
}

export const text = must("a text", (v) => typeof v === "string");
export const flag = must("true or false", (v) => typeof v === "boolean");
export const number = must("a number", (v) => Number.isFinite(v));
export const positive = must("a number above 0", (v) => Number.isFinite(v) && Number(v) > 0);
export const fromZero = must("a number from 0 on", (v) => Number.isFinite(v) && Number(v) >= 0);
export const share = must(
  "a number from 0 to 1",
  (v) => Number.isFinite(v) && Number(v) >= 0 && Number(v) <= 1,
);
export const between = (low: number, high: number): Check =>
  must(`a number from ${low} to ${high}`, (v) => Number.isFinite(v) && Number(v) >= low && Number(v) <= high);
export const whole = must("a whole number", Number.isSafeInteger);
export const amount = must("a whole number from 0 on", (v) => Number.isSafeInteger(v) && Number(v) >= 0);
export const level = must("a whole number from 1 on", (v) => Number.isSafeInteger(v) && Number(v) > 0);
export const hash = must("a sha-256 in hexadecimal", (v) => /^[0-9a-f]{64}$/.test(String(v)));
export const color = must("a colour as #rrggbb", (v) => /^#[0-9a-f]{6}$/i.test(String(v)));

const PLAIN = /^\w[\w.-]*(\/\w[\w.-]*)*$/; // relative, without scheme and without `..`
/** A path inside the bundle's folder. */
export const relative = must(
  "a path below the bundle's folder",
  (v) => typeof v === "string" && PLAIN.test(v),
);

/** One of the given strings or numbers. */
export const oneOf = (...allowed: readonly unknown[]): Check =>
  must(allowed.map((a) => JSON.stringify(a)).join(" or "), (v) => allowed.includes(v));

/** A list whose items pass `item`, optionally of a given length. */
export function list(item: Check, length?: number): Check {
  const shape = must(length === undefined ? "a list" : `a list of ${length}`, (v) => {
    return Array.isArray(v) && (length === undefined || v.length === length);
  });
  return (value, path, wrong) => {
    const before = wrong.length;
    shape(value, path, wrong);
    if (wrong.length > before || !Array.isArray(value)) return;
    value.forEach((v, i) => {
      item(v, `${path}[${i}]`, wrong);
    });
  };
}

/** An object with these fields; further fields are ignored, since later versions may add some. */
export function object(fields: Readonly<Record<string, Check>>): Check {
  const shape = must("an object", isObject);
  return (value, path, wrong) => {
    if (!isObject(value)) return shape(value, path, wrong);
    for (const [name, check] of Object.entries(fields))
      check(value[name], path ? `${path}.${name}` : name, wrong);
  };
}

export const orNull =
  (check: Check): Check =>
  (value, path, wrong) => {
    if (value !== null) check(value, path, wrong);
  };

/** The value if it passes the check; else throws a BundleError with the first few defects. */
export function checked<T>(value: unknown, check: Check, file: string): T {
  const wrong: string[] = [];
  check(value, "", wrong);
  refuse(wrong, file);
  return value as T;
}

/** Throws a BundleError if there are defects. */
export function refuse(wrong: readonly string[], file: string): void {
  if (!wrong.length) return;
  const named = wrong.slice(0, 8).map((line) => line.replace(/^ /, "the file "));
  const more = wrong.length > named.length ? `; and ${wrong.length - named.length} more` : "";
  throw new BundleError(`${file}: ${named.join("; ")}${more}. Make the bundle again with sagesplat bundle.`);
}
