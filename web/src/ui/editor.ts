import type { Category, Operation } from "../core/edits";
import { isTyping } from "../view/controls";
import { type Editor, SCOPES, type Scope } from "../view/editor";
import { h, iconButton, setText, textButton } from "./dom";
import { formatCount } from "./format";
import { messageOf } from "./notice";
import { save, saved } from "./saving";

const HINT = "Click what you mean, or turn until the cross is on it and press Enter";
const TITLES: Readonly<Record<Scope, readonly [string, string]>> = {
  instance: ["This one", "The instance"],
  category: ["Category", "The whole category"],
  alike: ["Alike", "What is joined to it and of like colour"],
};
const WEIGHTS = [0, 0.25, 0.5, 1, 2, 4];
const CLICK_TOLERANCE = 5; // px that a pointer may move in a click

type Action = "rename" | "split" | "merge" | "hide" | "full" | "save" | "open";

/** The card that labels are edited in; it opens with its button or L. */
export class EditorCard {
  readonly element: HTMLElement;
  readonly cross = h("div", { class: "cross", "aria-hidden": "true", hidden: true });
  private readonly status = h("p", { class: "picked", role: "status" });
  private readonly scopes: HTMLButtonElement[];
  private readonly narrower = button("−", "Less alike (-)", () => this.editor.widen(-1));
  private readonly wider = button("+", "More alike (+)", () => this.editor.widen(1));
  private readonly name = h("input", {
    type: "text",
    class: "field",
    "aria-label": "Name",
    placeholder: "Name",
  });
  private readonly into = h("select", { class: "field", "aria-label": "Category to merge with" });
  private readonly weight = h("select", {
    class: "field",
    "aria-label": "Weight",
    change: () => this.weigh(),
  });
  private readonly list = h("ul", { class: "tree", "aria-label": "Categories" });
  private readonly undo = iconButton("undo", "Undo (Ctrl Z)", () => this.editor.edits.undo());
  private readonly redo = iconButton("redo", "Redo (Ctrl Y)", () => this.editor.edits.redo());
  private readonly file = h("input", {
    type: "file",
    accept: ".json",
    hidden: true,
    change: () => this.load(),
  });
  private readonly actions: Readonly<Record<Action, HTMLButtonElement>>;
  private error = "";

  constructor(
    readonly editor: Editor,
    private readonly token: string | null,
    private readonly onToggle: (open: boolean) => void,
  ) {
    this.scopes = SCOPES.map((scope) => {
      const [text, title] = TITLES[scope];
      const click = () => editor.setScope(scope);
      return h("button", { type: "button", "aria-pressed": "false", title, click }, text);
    });
    this.weight.append(...WEIGHTS.map((w) => h("option", { value: w }, `× ${w}`)));
    this.actions = {
      rename: button("Rename", "Rename the category", () => this.rename()),
      split: button("Split off", "Make the selection a category of this name", () =>
        this.do(() => editor.split(this.name.value)),
      ),
      merge: button("Merge", "Merge with the chosen category", () => this.merge()),
      hide: button("Hide", "Hide or show (H)", () => this.hide()),
      full: button("Always in full", "Always in full (F)", () => this.full()),
      save: button(
        "Save",
        token ? "Save in the run folder" : "Download labels.edit.json",
        () => void this.save(),
      ),
      open: button("Open…", "Open a labels.edit.json", () => this.file.click()),
    };
    this.element = this.build();
    this.listen();
    editor.onChange(() => this.update());
  }

  toggle(open = !this.editor.isOpen): void {
    const why = this.editor.obstacle;
    this.error = "";
    this.editor.open(open);
    this.element.hidden = !open;
    this.cross.hidden = !open || why !== null;
    document.documentElement.classList.toggle("editing", open);
    this.onToggle(open);
    if (why) this.error = why;
    this.update();
    if (open) this.editor.viewer.stage.canvas.focus({ preventScroll: true });
  }

  private build(): HTMLElement {
    const { rename, split, merge, hide, full, save, open } = this.actions;
    const row = (...children: Node[]) => h("div", { class: "row" }, ...children);
    return h(
      "section",
      { class: "editor card", "aria-label": "Edit labels", hidden: true },
      h(
        "div",
        { class: "heading" },
        h("h2", {}, "Edit labels"),
        this.undo,
        this.redo,
        iconButton("close", "Close (L)", () => this.toggle(false)),
      ),
      this.status,
      h(
        "div",
        { class: "row scopes", role: "group", "aria-label": "Selection" },
        ...this.scopes,
        this.narrower,
        this.wider,
      ),
      row(this.name, rename, split),
      row(this.into, merge),
      row(hide, full, this.weight),
      this.list,
      row(save, open, this.file),
    );
  }

  private listen(): void {
    const { canvas } = this.editor.viewer.stage;
    let from: PointerEvent | null = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = event.isPrimary && event.button === 0 ? event : null;
    });
    canvas.addEventListener("pointerup", (event) => {
      const moved = from ? Math.hypot(event.clientX - from.clientX, event.clientY - from.clientY) : Infinity;
      const box = canvas.getBoundingClientRect();
      if (this.isActive && moved <= CLICK_TOLERANCE)
        this.pick(event.clientX - box.left, event.clientY - box.top);
    });
    window.addEventListener("keydown", (event) => this.key(event));
  }

  private get isActive(): boolean {
    return this.editor.isOpen && !this.editor.obstacle;
  }

  private pick(x: number, y: number): void {
    this.error = "";
    this.editor.pick(x, y);
    const { selection, isWaiting, isLoading } = this.editor;
    if (!selection && !isWaiting && !isLoading) this.error = "Nothing is there";
    this.update();
  }

  private key(event: KeyboardEvent): void {
    const { target, key } = event;
    if (!this.isActive || (isTyping(event) && key !== "Escape")) return;
    if (event.ctrlKey || event.metaKey) {
      const redo = key.toLowerCase() === "y" || (event.shiftKey && key.toLowerCase() === "z");
      if (!redo && key.toLowerCase() !== "z") return;
      event.preventDefault();
      if (redo) this.editor.edits.redo();
      else this.editor.edits.undo();
      return;
    }
    const { canvas } = this.editor.viewer.stage;
    const keys: Record<string, () => void> = {
      Escape: () => (this.editor.selection ? this.editor.clear() : this.toggle(false)),
      h: () => this.hide(),
      f: () => this.full(),
      "+": () => this.editor.widen(1),
      "-": () => this.editor.widen(-1),
    };
    if (key === "Enter" && (target === canvas || target === document.body)) {
      event.preventDefault();
      const [box, cross] = [canvas.getBoundingClientRect(), this.cross.getBoundingClientRect()];
      this.pick(cross.x + cross.width / 2 - box.left, cross.y + cross.height / 2 - box.top);
    } else keys[key]?.();
  }

  /** Does something that may not be possible, which is then said. */
  private do(action: () => void): void {
    this.error = "";
    try {
      action();
    } catch (error) {
      this.error = messageOf(error);
    }
    this.update();
  }

  private each(make: (one: Category) => Operation): void {
    this.do(() => this.editor.apply(...this.editor.selectedCategories.map(make)));
  }

  private rename(): void {
    const [one] = this.editor.selectedCategories;
    if (one) this.do(() => this.editor.apply({ op: "rename", category: one.name, to: this.name.value }));
  }

  private merge(): void {
    const into = this.into.value;
    const others = this.editor.selectedCategories.filter(({ name }) => name !== into);
    this.do(() =>
      this.editor.apply(...others.map(({ name }) => ({ op: "merge", category: name, into }) as const)),
    );
  }

  private hide(): void {
    const hidden = !this.editor.selectedCategories.every((one) => one.hidden);
    this.each(({ name }) => ({ op: "hide", category: name, hidden }));
  }

  private full(): void {
    const always = !this.editor.selectedCategories.every((one) => one.always);
    this.each(({ name }) => ({ op: "full", category: name, always }));
  }

  private weigh(): void {
    const weight = Number(this.weight.value);
    this.each(({ name }) => ({ op: "weigh", category: name, weight }));
  }

  private async save(): Promise<void> {
    try {
      this.error = await save(this.editor.edits.dump(), this.token);
    } catch (error) {
      this.error = messageOf(error);
    }
    this.update();
  }

  /** Opens with what the server has of earlier edits. */
  async resume(): Promise<void> {
    this.toggle(true);
    const json = this.token === null ? null : await saved(this.token);
    if (json) this.do(() => this.editor.edits.load(json));
  }

  private async load(): Promise<void> {
    const json = await this.file.files?.[0]?.text();
    this.file.value = "";
    if (json !== undefined) this.do(() => this.editor.edits.load(json));
  }

  update(): void {
    if (!this.editor.isOpen) return;
    const { editor } = this;
    const { edits, selection } = editor;
    setText(this.status, this.error || this.sentence());
    this.status.classList.toggle("warn", this.error !== "");
    const available = editor.available;
    this.scopes.forEach((element, i) => {
      const scope = SCOPES[i] as Scope;
      element.disabled = !available.includes(scope);
      element.setAttribute("aria-pressed", String(selection?.scope === scope && available.includes(scope)));
    });
    this.undo.disabled = !edits.canUndo;
    this.redo.disabled = !edits.canRedo;
    this.updateFields();
    this.updateList();
  }

  private sentence(): string {
    const { editor } = this;
    if (editor.isWaiting) return "Loading the rest of this category…";
    if (editor.isLoading) return "Loading the full model, which edits are of…";
    const names = editor.selectedCategories.map(({ title }) => title);
    if (!editor.selection) return HINT;
    const part = editor.selection.scope === "alike" ? "part of " : "";
    return `${part}${names.join(", ")} · ${formatCount(editor.selection.count)} splats`;
  }

  private updateFields(): void {
    const { editor } = this;
    const { rename, split, merge, hide, full, save } = this.actions;
    const chosen = editor.selectedCategories;
    const [one] = chosen;
    const { selection } = editor;
    const part = selection?.scope === "alike";
    const set = (element: HTMLButtonElement | HTMLSelectElement, usable: boolean) => {
      element.disabled = !usable;
    };
    set(rename, chosen.length === 1 && !part);
    set(split, part);
    set(merge, chosen.length > 0 && !part);
    set(this.into, chosen.length > 0 && !part);
    for (const element of [hide, full, this.weight]) set(element, chosen.length > 0 && !part);
    set(save, editor.edits.canUndo);
    setText(hide, chosen.length && chosen.every((c) => c.hidden) ? "Show" : "Hide");
    full.setAttribute("aria-pressed", String(chosen.length > 0 && chosen.every((c) => c.always)));
    this.narrower.hidden = this.wider.hidden = !part;
    if (document.activeElement !== this.weight) this.weight.value = String(one?.weight ?? 1);
    if (document.activeElement !== this.name)
      this.name.value = part ? "" : chosen.length === 1 ? (one?.name ?? "") : "";
    const names = this.editor.edits.categories.present.flatMap((i) => editor.edits.categories.list[i] ?? []);
    const others = names.filter((c) => chosen.length !== 1 || c !== one);
    if (others.map((c) => c.name).join("\n") === [...this.into.options].map((o) => o.value).join("\n"))
      return;
    this.into.replaceChildren(...others.map((c) => h("option", { value: c.name }, c.title)));
  }

  /** The categories, instances below what they are of; each is a button that selects it. */
  private updateList(): void {
    const { categories } = this.editor.edits;
    const counts = categories.counts();
    const selected = new Set(this.editor.selectedNumbers);
    const groups = new Map<string, number[]>();
    for (const number of categories.present) {
      const one = categories.list[number] as Category;
      const key = one.parent ?? one.name;
      groups.set(key, [...(groups.get(key) ?? []), number]);
    }
    const key = JSON.stringify([[...groups], [...selected], categories.list, counts]);
    if (this.list.dataset.key === key) return;
    const focused = [...this.list.querySelectorAll("button")].indexOf(
      document.activeElement as HTMLButtonElement,
    );
    this.list.dataset.key = key;
    const entry = (numbers: readonly number[], title: string) => {
      const all = numbers.map((number) => categories.list[number] as Category);
      const marks = [all.every((c) => c.hidden) && "hidden", all.every((c) => c.always) && "in full"];
      const splats = formatCount(numbers.reduce((sum, number) => sum + (counts[number] ?? 0), 0));
      const facts = [splats, ...marks.filter((mark) => mark !== false)].join(" · ");
      return h(
        "button",
        {
          type: "button",
          "aria-pressed": String(numbers.every((number) => selected.has(number))),
          click: () => this.editor.selectCategories(numbers),
        },
        h("span", {}, title),
        h("small", {}, facts),
      );
    };
    this.list.replaceChildren(
      ...[...groups].map(([name, numbers]) => {
        const titles = numbers.map((number) => categories.list[number]?.title ?? "");
        if (numbers.length === 1) return h("li", {}, entry(numbers, titles[0] ?? name));
        const parts = numbers.map((number, i) => h("li", {}, entry([number], titles[i] ?? "")));
        return h("li", {}, entry(numbers, name), h("ul", { "aria-label": `Parts of ${name}` }, ...parts));
      }),
    );
    if (focused >= 0) this.list.querySelectorAll("button")[focused]?.focus();
  }
}

const button = (text: string, title: string, click: () => void): HTMLButtonElement =>
  textButton(text, "text", click, { title, "aria-label": title });
