import type { Plugin } from "vite";

const SHADER = /^((?:var|const) [\w$]+ = )"((?:[^"\\]|\\.)*)";$/gm;
// by Spark's shaders, and by what three.js puts before all shaders
const IS_USED = /^var (?:logdepthbuf_\w+|(?:colorspace|tonemapping)_pars_fragment) = /;

/** three.js without the shaders of its own materials, a tenth of the script: splats have their own. */
export function three(): Plugin {
  return {
    name: "three-without-shaders",
    enforce: "pre",
    transform(code, id) {
      if (!/three\/build\/three\.module\.js$/.test(id.split("?")[0] ?? "")) return null;
      let count = 0;
      const changed = code.replace(SHADER, (whole, name: string, text: string) => {
        if (!/gl_|#if|#define|uniform /.test(text) || IS_USED.test(whole)) return whole;
        count += 1;
        return `${name}"";`;
      });
      if (count < 100) throw new Error(`three.js has changed: ${count} shaders`);
      return { code: changed, map: null };
    },
  };
}
