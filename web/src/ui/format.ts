import type { Quality, Screens } from "../types";

/** "1.2 MB", with at least two digits; decimal units. */
export function formatBytes(bytes: number): string {
  if (!Number.isFinite(bytes)) return "no limit";
  if (bytes < 1000) return `${Math.round(bytes)} B`;
  const kilo = bytes / 1000;
  if (kilo < 999.5) return `${kilo < 10 ? kilo.toFixed(1) : Math.round(kilo)} kB`;
  const mega = kilo / 1000;
  return `${mega < 100 ? mega.toFixed(mega < 10 ? 2 : 1) : Math.round(mega)} MB`;
}

/** "980", "28 k", "1.3 M". */
export function formatCount(count: number): string {
  if (!Number.isFinite(count)) return "no limit";
  if (count < 1000) return String(Math.round(count));
  const kilo = count / 1000;
  if (kilo < 999.5) return `${kilo < 10 ? kilo.toFixed(1) : Math.round(kilo)} k`;
  return `${(kilo / 1000).toFixed(2)} M`;
}

/** Metres; "–" for an unknown distance. */
export function formatDistance(metres: number): string {
  if (!Number.isFinite(metres)) return "–";
  return `${metres < 10 ? metres.toFixed(1) : Math.round(metres)} m`;
}

/** What a quality is called in a sentence. */
export const nameOf = (quality: Quality): string => (quality === "fidelity" ? "fidelity" : "SSIM");

/**
 * The screens and lenses that promises are for. A larger screen is promised what its
 * picture has, averaged down to the largest.
 *
 * @param height - of what is drawn, pixels
 * @param photos - what they are called
 */
export function formatScreens(
  { least, most, here, fov }: Screens,
  height: number,
  photos = "photos",
): string {
  const from = least < most ? `${Number(least.toPrecision(2))} to ` : "";
  const times = `of ${from}${Number(most.toPrecision(2))} times the ${photos}' sharpness`;
  const screens = least === 1 && most === 1 ? `as sharp as the ${photos}` : times;
  const lenses = fov === undefined ? "" : ` and lenses up to ${fov}°`;
  const known = `Promises are for screens ${screens}${lenses}`;
  const averaged = `; compared as averaged down to ${Math.round((height * most) / here)} px`;
  return here > most ? known + averaged : known;
}

/** "37 %"; "100 %" is all of it, "0 %" nothing. */
export function formatShare(share: number): string {
  const percent = Math.round(100 * share);
  if (percent === 0 && share > 0) return "< 1 %";
  return `${percent === 100 && share < 1 ? 99 : percent} %`;
}

export function formatSsim(ssim: number): string {
  return Number.isFinite(ssim) ? ssim.toFixed(2) : "–";
}

const ENDINGS = /\.(compressed|cleaned|ply|splat|ksplat|spz|sog|gltf|glb)$/i;

/** What a scene is called in a title: its name, which may be that of a file. */
export function formatName(name: string): string {
  let title = name;
  while (ENDINGS.test(title)) title = title.replace(ENDINGS, "");
  title = title.replace(/_+/g, " ").trim();
  return title ? title.charAt(0).toUpperCase() + title.slice(1) : name;
}

/** What a fidelity looks like beside the full scene, in a few words; of SSIM against photos nothing is said. */
export function formatLook(quality: Quality, target: number): string {
  if (quality !== "fidelity") return "";
  const looks: readonly (readonly [number, string])[] = [
    [0.975, "hardly to be told from the full scene"],
    [0.93, "differences show only side by side"],
    [0.85, "the finest texture is a little softer"],
    [0.75, "leaves and stone are softer, shapes stay"],
    [0.6, "texture is smoothed away, edges are soft"],
    [0, "shapes and colours only"],
  ];
  return looks.find(([from]) => target >= from)?.[1] ?? "";
}
