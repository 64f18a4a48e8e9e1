/** Checks untrusted JSON by a JSON Schema: reports all defects with their paths. */

/** A defect of a bundle, as one line for the user. */
export class BundleError extends Error {
  override name = "BundleError";
}

/** The part of JSON Schema that manifest.schema.json uses. */
export interface Schema {
  readonly $defs?: Readonly<Record<string, Schema>>;
  readonly $ref?: string; // #/$defs/NAME
  readonly anyOf?: readonly Schema[];
  readonly type?: keyof typeof TYPES;
  readonly const?: unknown;
  readonly enum?: readonly unknown[];
  readonly minimum?: number;
  readonly maximum?: number;
  readonly exclusiveMinimum?: number;
  readonly exclusiveMaximum?: number;
  readonly pattern?: string;
  readonly description?: string; // of a pattern, in words
  readonly items?: Schema;
  readonly minItems?: number;
  readonly maxItems?: number;
  readonly properties?: Readonly<Record<string, Schema>>;
  readonly required?: readonly string[];
}

/** What each type is called in messages, and its test. */
const TYPES = {
  null: ["nothing", (v: unknown) => v === null],
  string: ["a text", (v: unknown) => typeof v === "string"],
  boolean: ["true or false", (v: unknown) => typeof v === "boolean"],
  number: ["a number", (v: unknown) => Number.isFinite(v)],
  integer: ["a whole number", (v: unknown) => Number.isSafeInteger(v)],
  array: ["a list", (v: unknown) => Array.isArray(v)],
  object: ["an object", (v: unknown) => typeof v === "object" && v !== null && !Array.isArray(v)],
} as const;

/** The value if it fits the schema, or a definition of the schema; else throws a BundleError. */
export function checked<T>(value: unknown, root: Schema, file: string, schema: Schema = root): T {
  const wrong: string[] = [];
  check(value, schema, root, "", wrong);
  refuse(wrong, file);
  return value as T;
}

/** Throws a BundleError with the first few defects, if there are any. */
export function refuse(wrong: readonly string[], file: string): void {
  if (!wrong.length) return;
  const named = wrong.slice(0, 8).map((line) => line.replace(/^ /, "the file "));
  const more = wrong.length > named.length ? `; and ${wrong.length - named.length} more` : "";
  throw new BundleError(`${file}: ${named.join("; ")}${more}. Make the bundle again with sagesplat bundle.`);
}

/** Appends the defects of a value at a path. Fields without a schema are ignored: later versions may add some. */
function check(value: unknown, schema: Schema, root: Schema, path: string, wrong: string[]): void {
  if (schema.$ref) {
    const found = root.$defs?.[schema.$ref.replace("#/$defs/", "")];
    if (!found) throw new Error(`The schema has no ${schema.$ref}.`);
    check(value, found, root, path, wrong);
  } else if (schema.anyOf) {
    const defects = schema.anyOf.map((one) => {
      const own: string[] = [];
      check(value, one, root, path, own);
      return own;
    });
    if (defects.every((own) => own.length)) wrong.push(...(defects.at(-1) ?? []));
  } else if (!fits(value, schema)) {
    wrong.push(`${path} must be ${expected(schema)}`);
  } else if (Array.isArray(value)) {
    const { items } = schema;
    if (items) for (const [i, item] of value.entries()) check(item, items, root, `${path}[${i}]`, wrong);
  } else if (schema.properties) {
    checkFields(value as Readonly<Record<string, unknown>>, schema, root, path, wrong);
  }
}

function checkFields(
  value: Readonly<Record<string, unknown>>,
  { properties = {}, required = [] }: Schema,
  root: Schema,
  path: string,
  wrong: string[],
): void {
  const before = path && `${path}.`;
  for (const [name, schema] of Object.entries(properties)) {
    if (value[name] !== undefined) check(value[name], schema, root, before + name, wrong);
    else if (required.includes(name)) wrong.push(`${before}${name} is missing`);
  }
}

/** Whether a value is as the schema says, apart from its items or fields. */
function fits(value: unknown, schema: Schema): boolean {
  const { type, minimum = -Infinity, maximum = Infinity, minItems = 0, maxItems = Infinity } = schema;
  const { exclusiveMinimum = -Infinity, exclusiveMaximum = Infinity } = schema;
  if ("const" in schema) return value === schema.const;
  if (schema.enum) return schema.enum.includes(value);
  if (type && !TYPES[type][1](value)) return false;
  if (typeof value === "number")
    return value >= minimum && value <= maximum && value > exclusiveMinimum && value < exclusiveMaximum;
  if (typeof value === "string")
    return schema.pattern === undefined || new RegExp(schema.pattern).test(value);
  return !Array.isArray(value) || (value.length >= minItems && value.length <= maxItems);
}

/** What a value must be, in words. */
function expected(schema: Schema): string {
  const { type = "null", minimum, maximum, exclusiveMinimum, exclusiveMaximum, minItems, maxItems } = schema;
  const { pattern, description = "" } = schema;
  if (pattern) return description.replace(/^A/, "a").replace(/\.$/, "");
  const allowed = "const" in schema ? [schema.const] : schema.enum;
  if (allowed) return allowed.map((one) => JSON.stringify(one)).join(" or ");
  const parts: (string | false)[] = [
    TYPES[type][0],
    minimum !== undefined && `from ${minimum}`,
    minimum !== undefined && maximum === undefined && "on",
    exclusiveMinimum !== undefined && `above ${exclusiveMinimum}`,
    maximum !== undefined && `to ${maximum}`,
    exclusiveMaximum !== undefined && `below ${exclusiveMaximum}`,
    minItems !== undefined && minItems !== maxItems && `of at least ${minItems}`,
    maxItems !== undefined && `of ${minItems === maxItems ? "" : "at most "}${maxItems}`,
  ];
  return parts.filter((part) => part).join(" ");
}
