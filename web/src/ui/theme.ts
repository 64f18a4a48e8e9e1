import { remember, remembered } from "../core/storage";

const KEY = "sagesplat-theme";
const THEMES = ["auto", "light", "dark"] as const;
type Theme = (typeof THEMES)[number];

let theme: Theme = THEMES.find((name) => name === remembered(KEY)) ?? "auto";
show();

function show(): void {
  document.documentElement.dataset.theme = theme;
}

/** Switches between light, dark and the system's theme; returns the new one. */
export function nextTheme(): Theme {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const order: readonly Theme[] = dark ? ["auto", "light", "dark"] : ["auto", "dark", "light"];
  theme = order[(order.indexOf(theme) + 1) % order.length] ?? "auto";
  show();
  remember(KEY, theme);
  return theme;
}
