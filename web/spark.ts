import { minifySync, type Plugin } from "vite";
import { backToFront } from "./src/core/sort.ts";

const WASM =
  /const WASM = decode64\("([\w+/=]+)"\)\.buffer;\nconst WASM_MODULE = WebAssembly\.compile\(WASM\);/;
const WORKER = /const jsContent = ('(?:[^'\\]|\\.)*');/;
const MANY = 300_000; // splats from which its WebAssembly is worth loading for sorting alone

/**
 * Spark without its WebAssembly in the first picture's way. As published it is three quarters of
 * the viewer's code, as base64 in the script, and is waited for. Here it is a file, asked for where splats are to be decoded
 * from SPZ or PLY, or many of them sorted; till then splats are sorted by `backToFront`.
 *
 * @param isInline - keeps it in the script, for those who want one file
 */
export function spark(isInline = false): Plugin {
  return {
    name: "spark-without-wasm",
    enforce: "pre",
    transform(code, id) {
      if (!/@sparkjsdev\/spark\/dist\/spark\.module\.js$/.test(id.split("?")[0] ?? "")) return null;
      const [, wasm] = matched(code, WASM);
      const [, worker] = matched(code, WORKER);
      const bytes = Buffer.from(wasm as string, "base64");
      const url = isInline
        ? `"data:application/wasm;base64,${wasm}"`
        : `import.meta.ROLLUP_FILE_URL_${this.emitFile({ type: "asset", name: "spark.wasm", source: bytes })}`;
      const changed = replaced(code, [
        [WASM, () => `const WASM_MODULE = lazy(${url});`],
        [
          WORKER,
          () => `const jsContent = ${JSON.stringify(small(sorting(new Function(`return ${worker}`)())))};`,
        ],
        [
          /const initialization = __wbg_init\(\{ module_or_path: WASM_MODULE \}\)\.then\(\n.*\n.*\n.*\n\);/,
          () =>
            "const initialization = { then: (...args) => __wbg_init({ module_or_path: WASM_MODULE }).then(...args) };",
        ],
        [/ {4}WASM_MODULE\.then\(\(module\) => \{\n.*"init-wasm".*\n {4}\}\);\n/, () => ""],
        [
          / {4}this\.worker\.postMessage\(\n {6}\{ id, name, args \},/,
          (found) =>
            `    if (!this.asked && (name !== "sortSplats32" || args.numSplats > ${MANY})) {
      this.asked = true;
      WASM_MODULE.then(
        (module) => this.worker.postMessage({ name: "init-wasm", module }),
        (error) => {
          if (name !== "sortSplats32") this.onMessage({ data: { id, error } });
        },
      );
    }
${found}`,
        ],
      ]);
      return {
        code: `import { lazy } from "${import.meta.dirname}/src/view/wasm.ts";\n${changed}`,
        map: null,
      };
    },
  };
}

/** The script of Spark's worker, which sorts before it has its WebAssembly. */
function sorting(script: string): string {
  return replaced(script, [
    [
      /sort32_splats\(numSplats, readback, ordering\);\n/,
      () => "(wasm ? sort32_splats : backToFront)(numSplats, readback, ordering);\n",
    ],
    [
      / {6}pending\.push\(event\);\n/,
      (found) =>
        `      if (event.data.name === "sortSplats32") {
        onMessage(event);
        return;
      }
${found}`,
    ],
    [/ {2}function sortSplats32\(/, (found) => `  ${backToFront.toString()}\n${found}`],
  ]);
}

/** A script without what only people read. */
function small(script: string): string {
  const { code, errors } = minifySync("worker.js", script);
  if (errors.length) throw new Error(`Spark has changed: ${errors[0]?.message}`);
  return code;
}

type Change = readonly [pattern: RegExp, by: (found: string) => string];

function replaced(code: string, changes: readonly Change[]): string {
  return changes.reduce((text, [pattern, by]) => text.replace(pattern, by(matched(text, pattern)[0])), code);
}

function matched(code: string, pattern: RegExp): RegExpMatchArray {
  const found = [...code.matchAll(new RegExp(pattern, "g"))];
  if (found.length !== 1) throw new Error(`Spark has changed: ${found.length} times ${pattern}`);
  return found[0] as RegExpMatchArray;
}
