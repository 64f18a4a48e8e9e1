type Props = Readonly<Record<string, string | number | boolean | ((event: Event) => void)>>;

/** An element: functions become listeners, `true` an empty attribute, `false` none. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  props: Props = {},
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(props)) {
    if (typeof value === "function") element.addEventListener(key, value);
    else if (value !== false) element.setAttribute(key, value === true ? "" : String(value));
  }
  element.append(...children);
  return element;
}

const ICONS = {
  eye: "M2.5 12S6 5.5 12 5.5 21.5 12 21.5 12 18 18.5 12 18.5 2.5 12 2.5 12ZM12 9.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6Z",
  edit: "M4 20l1-4.5L16.5 4 20 7.5 8.5 19 4 20ZM14 6.5l3.5 3.5",
  undo: "M8 5 4 9l4 4M4 9h9.5a5.5 5.5 0 0 1 0 11H9",
  redo: "M16 5l4 4-4 4M20 9h-9.5a5.5 5.5 0 0 0 0 11H15",
  close: "M6 6l12 12M18 6 6 18",
  closed: "M3 10.5c2 3 5 5 9 5s7-2 9-5M5.5 14l-1.8 2.2M12 15.5v3M18.5 14l1.8 2.2",
  orbit: "M20 12a8 8 0 1 1-2.6-5.9M20.3 3.4v4.3H16M12 9.8a2.2 2.2 0 1 0 0 4.4 2.2 2.2 0 0 0 0-4.4Z",
  walk: "M13 3.2a1.6 1.6 0 1 0 0 3.2 1.6 1.6 0 0 0 0-3.2ZM12.5 9l-1.8 5 3 2.6.8 4.4M10.7 14l-1.2 3-2.7 3.5M12.5 9l-3.4 1.4-.9 3M12.5 9l2.2 2.8 2.9.6",
  compare: "M12 3v18M5 6h4M5 6v12h4M15 6h4v12h-4M8 12H6.5M17.5 12H16",
  tint: "M12 3.5c3 3.8 5.5 6.6 5.5 10a5.5 5.5 0 0 1-11 0c0-3.4 2.5-6.2 5.5-10ZM12 17c-1.8 0-3-1.2-3-3",
  help: "M9.2 9.2a2.9 2.9 0 1 1 4.3 2.5c-1 .6-1.5 1.1-1.5 2.3M12 17.2v.1M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18Z",
  theme: "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18ZM12 3v18M12 7l6-2M12 12h9M12 17l6 2",
  previous: "M14.5 6 8.5 12l6 6",
  next: "M9.5 6l6 6-6 6",
  chevron: "M6 9.5l6 6 6-6",
  headset:
    "M4 8.5h16a1.5 1.5 0 0 1 1.5 1.5v5a2 2 0 0 1-2 2h-4l-2-2.5h-3L8.5 17h-4a2 2 0 0 1-2-2v-5A1.5 1.5 0 0 1 4 8.5Z",
} as const;
export type IconName = keyof typeof ICONS;

export function icon(name: IconName): SVGSVGElement {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", ICONS[name]);
  svg.append(path);
  return svg;
}

export function setIcon(button: HTMLElement, name: IconName): void {
  button.querySelector("svg")?.replaceWith(icon(name));
}

/** A button with a text, in one of the styles that style.css has. */
export const textButton = (
  text: string,
  className: "primary" | "text",
  click: () => void,
  props: Props = {},
): HTMLButtonElement => h("button", { type: "button", class: className, click, ...props }, text);

/** A button with an icon; its title is the tooltip and the accessible name. */
export function iconButton(
  name: IconName,
  title: string,
  onClick: () => void,
  className = "icon",
): HTMLButtonElement {
  return h(
    "button",
    { type: "button", class: className, title, "aria-label": title, click: onClick },
    icon(name),
  );
}

/** Whether fingers are the main pointer. */
export const isTouch = (): boolean => matchMedia("(pointer: coarse)").matches;

/** Sets text only if it changed, to avoid a new layout. */
export function setText(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}
