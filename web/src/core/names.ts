/** What a name may be, by the rules of src/sagesplat/core/names.py. */

export const LENGTH = 100; // characters of a name, at most
const RULE = `a name has 1 to ${LENGTH} printable characters and no space at its ends`;
const FILLERS = /[\u115f\u1160\u2800\u3164\uffa0]/gu; // letters and symbols that look like a space
const UNSEEN = /[\p{C}\p{Zl}\p{Zp}]/u;
const SEEN = /[\p{L}\p{N}\p{P}\p{S}]/u;

/** The name in Unicode's composed form; throws an Error, which says why, for what is none. */
export function checkedName(given: string): string {
  const name = given.normalize("NFC");
  const unseen = UNSEEN.exec(name)?.[0];
  const why = (() => {
    if (unseen) return `it holds a control or invisible character, U+${hex(unseen)}`;
    if (!SEEN.test(name.replace(FILLERS, ""))) return "it is blank";
    if (name !== name.trim()) return "it begins or ends with a space";
    const length = [...name].length;
    return length > LENGTH ? `it has ${length} characters` : null;
  })();
  if (why) throw new Error(`Not a name: ${why}; ${RULE}.`);
  return name;
}

const hex = (c: string): string => (c.codePointAt(0) ?? 0).toString(16).toUpperCase().padStart(4, "0");
