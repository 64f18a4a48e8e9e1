"""What a page has to keep for everybody, after axe and WCAG 2.2 AA: contrast, names, sizes, keyboard."""

from typing import Any

# the sentences of everything that is wrong with the page as it stands
RULES = r"""() => {
  const wrong = [];
  const context = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d");
  const rgba = (color) => {
    context.clearRect(0, 0, 1, 1);
    context.fillStyle = color;
    context.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = context.getImageData(0, 0, 1, 1).data;
    return [r / 255, g / 255, b / 255, a / 255];
  };
  const over = ([r, g, b, a], under) => [r, g, b].map((c, i) => c * a + under[i] * (1 - a));
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ratio = (one, other) => {
    const [low, high] = [luminance(one), luminance(other)].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  };
  const named = (element) => {
    const text = element.textContent.trim().replace(/\s+/g, " ").slice(0, 40);
    const kind = element.getAttribute("class");
    return `<${element.localName}${kind ? ` class="${kind}"` : ""}> ${text}`;
  };
  const shown = (element) =>
    element.checkVisibility({ checkVisibilityCSS: true }) && element.getBoundingClientRect().width > 1;

  // what may be behind a text: a translucent card that floats may have anything under it
  const backdrops = (element) => {
    const layers = [];
    for (let at = element; at; at = at.parentElement) {
      const style = getComputedStyle(at);
      const color = rgba(style.backgroundColor);
      if (color[3] > 0) layers.push(color);
      if (color[3] === 1) return [layers];
      if (color[3] > 0 && ["fixed", "absolute"].includes(style.position)) {
        return [[...layers, [0, 0, 0, 1]], [...layers, [1, 1, 1, 1]]];
      }
    }
    return [[...layers, [1, 1, 1, 1]]];
  };
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const seen = new Set();
  while (texts.nextNode()) {
    const element = texts.currentNode.parentElement;
    const idle = element.closest("script, style, option, :disabled, [aria-hidden=true]");
    if (!texts.currentNode.data.trim() || seen.has(element) || idle || !shown(element)) continue;
    seen.add(element);
    const style = getComputedStyle(element);
    let opacity = 1;
    for (let at = element; at; at = at.parentElement) opacity *= Number(getComputedStyle(at).opacity);
    if (opacity === 0) continue;
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    for (const layers of backdrops(element)) {
      const under = layers.reduceRight((below, layer) => over(layer, below), [1, 1, 1]);
      const ink = rgba(style.color);
      const found = ratio(over([...ink.slice(0, 3), ink[3] * opacity], under), under);
      if (found < (large ? 3 : 4.5)) wrong.push(`contrast ${found.toFixed(2)}: ${named(element)}`);
    }
  }

  const focusable = "a[href], button, input, select, textarea, summary, [tabindex]:not([tabindex='-1'])";
  for (const element of document.querySelectorAll(focusable)) {
    if (!shown(element)) continue;
    const labels = [...(element.labels ?? [])].map((label) => label.textContent).join("");
    const by = document.getElementById(element.getAttribute("aria-labelledby"))?.textContent;
    const pictures = [...element.querySelectorAll("img[alt]")].map((image) => image.alt).join("");
    const own = element.matches("select, input") ? "" : element.textContent;
    const name = element.getAttribute("aria-label") || by || labels || own.trim() || pictures;
    if (!name && !element.title) wrong.push(`no name: ${named(element)}`);
    const box = element.getBoundingClientRect();
    const inline = getComputedStyle(element).display === "inline";
    const small = Math.min(box.width, box.height) < 24;
    const slider = element.type === "range" && box.height >= 20; // its thumb is what is dragged
    if (element.matches("button, input, select") && small && !inline && !slider) {
      const size = `${Math.round(box.width)} x ${Math.round(box.height)}`;
      wrong.push(`smaller than 24 px (${size}): ${named(element)}`);
    }
  }
  for (const image of document.images) {
    if (!image.hasAttribute("alt")) wrong.push(`no alt: ${image.src.slice(0, 60)}`);
  }
  const ids = [...document.querySelectorAll("[id]")].map(({ id }) => id);
  for (const id of new Set(ids.filter((id, i) => ids.indexOf(id) !== i))) wrong.push(`id twice: ${id}`);
  let before = 0;
  for (const heading of [...document.querySelectorAll("h1, h2, h3, h4")].filter(shown)) {
    const level = Number(heading.localName[1]);
    if (level > before + 1) wrong.push(`heading jumps to ${level}: ${named(heading)}`);
    before = level;
  }
  if (!document.documentElement.lang) wrong.push("no language");
  if (!document.title) wrong.push("no title");
  if (![...document.querySelectorAll("main, [role=main]")].some(shown)) wrong.push("no main part");
  const wide = document.documentElement.scrollWidth;
  if (wide > innerWidth) wrong.push(`${wide} px wide in a window of ${innerWidth}`);
  return wrong;
}"""
# the element in focus: its place among all, whether one sees it, and where the focus is
FOCUS = r"""() => {
  const element = document.activeElement;
  if (!element || element === document.body) return null;
  const style = getComputedStyle(element);
  const box = element.getBoundingClientRect();
  const inside = box.bottom > 0 && box.right > 0 && box.top < innerHeight && box.left < innerWidth;
  return {
    at: [...document.querySelectorAll("*")].indexOf(element),
    ringed: style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0,
    inside,
    what: element.outerHTML.slice(0, 100),
  };
}"""


def wrong_with(page: Any) -> list[str]:
    """What is wrong with an open page, as it stands."""
    return page.evaluate(RULES)


def wrong_with_keyboard(page: Any, most: int = 60) -> list[str]:
    """What is wrong with the way of the focus over a page: order, visibility; nothing reached at all."""
    page.evaluate("document.activeElement?.blur()")
    wrong, before, steps = [], -1, 0
    while steps < most:
        page.keyboard.press("Tab")
        now = page.evaluate(FOCUS)
        if now is None or now["at"] < before:  # around the end
            break
        if now["at"] == before:
            wrong.append(f"focus is stuck: {now['what']}")
            break
        if not now["ringed"]:
            wrong.append(f"focus is not shown: {now['what']}")
        if not now["inside"]:
            wrong.append(f"focus is out of the window: {now['what']}")
        before, steps = now["at"], steps + 1
    return wrong if steps else [*wrong, "the keyboard reaches nothing"]
