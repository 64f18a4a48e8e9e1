const KEY = "sagesplat-theme";
const THEMES = ["auto", "light", "dark"] as const;
type Theme = (typeof THEMES)[number];

function stored(): string | null {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // storage may be blocked; the theme is then not remembered
  }
}

let theme: Theme = THEMES.find((name) => name === stored()) ?? "auto";
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
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // as above
  }
  return theme;
}
