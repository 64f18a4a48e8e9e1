import { h, textButton } from "./dom";

/** Shows an error in place of the scene, with a button to reload. */
export function fail(message: string): void {
  const again = textButton("Try again", "primary", () => location.reload());
  const box = document.getElementById("notice");
  document.getElementById("poster")?.remove();
  box?.replaceChildren(h("h1", {}, "The scene cannot be shown"), h("p", { role: "alert" }, message), again);
  box?.removeAttribute("hidden");
}

export function hideNotice(): void {
  document.getElementById("notice")?.setAttribute("hidden", "");
}

export const messageOf = (error: unknown): string => (error instanceof Error ? error.message : String(error));
