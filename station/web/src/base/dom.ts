// Builds the page from text nodes: no text from a robot is ever read as HTML.

type Attributes = Readonly<Record<string, string>>;

export function el<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

/** A text that is written only when it changes, because writing costs a layout. */
export class Text {
  readonly node: HTMLElement;
  private readonly text = document.createTextNode("");

  constructor(className: string, tag: keyof HTMLElementTagNameMap = "span", attributes: Attributes = {}) {
    this.node = el(tag, { class: className, ...attributes }, this.text);
  }

  set(text: string): void {
    if (this.text.data !== text) this.text.data = text;
  }
}

export function byId(id: string): HTMLElement {
  const node = document.getElementById(id);
  if (!node) throw new Error(`the page has no #${id}`);
  return node;
}

export function setText(node: Node, text: string): void {
  if (node.textContent !== text) node.textContent = text;
}

export function setAttribute(node: Element, name: string, value: string): void {
  if (node.getAttribute(name) !== value) node.setAttribute(name, value);
}

/** A button that calls back when it is pressed. */
export function button(text: string, pressed?: () => void, attributes: Attributes = {}): HTMLButtonElement {
  const node = el("button", { type: "button", class: "tool", ...attributes }, text);
  if (pressed) node.addEventListener("click", pressed);
  return node;
}

/** A framed part of the page with a heading, and what stands beside that. */
export function panel(
  title: string,
  name: string,
  beside: readonly (Node | string)[],
  ...children: (Node | string)[]
): HTMLElement {
  const header = el("header", {}, el("h3", {}, title), ...beside);
  return el("section", { class: `panel ${name}`.trim(), "aria-label": title }, header, ...children);
}

export function table(head: readonly string[], body: HTMLElement): HTMLElement {
  const cells = head.map((text) => el("th", { scope: "col" }, text));
  return el("table", {}, el("thead", {}, el("tr", {}, ...cells)), body);
}

/** The choices of a list: each value with its label, or values that are their own. */
export function choices(
  of: readonly string[] | readonly (readonly [value: string, label: string])[],
): Node[] {
  return of.map((each) => {
    const [value, label] = typeof each === "string" ? [each, each] : each;
    return el("option", { value }, label);
  });
}

/** A list's items: what has not changed keeps its node, and with it the focus and a pressed button. */
export class Items<T> {
  private kept = new Map<string, HTMLElement>();

  /** `item` makes an entry's node from the entry alone; no two entries are equal. */
  constructor(
    private readonly list: HTMLElement,
    private readonly item: (entry: T) => HTMLElement,
  ) {}

  fill(entries: readonly T[]): void {
    const before = this.kept;
    this.kept = new Map(
      entries.map((entry) => {
        const key = JSON.stringify(entry);
        return [key, before.get(key) ?? this.item(entry)];
      }),
    );
    for (const [key, node] of before) if (!this.kept.has(key)) node.remove();
    // A node that is moved would lose the focus.
    [...this.kept.values()].forEach((node, i) => {
      const there = this.list.children[i] ?? null;
      if (there !== node) this.list.insertBefore(node, there);
    });
  }
}

/** A form that calls back instead of leaving the page. */
export function form(
  attributes: Attributes,
  submitted: () => void,
  ...children: (Node | string)[]
): HTMLFormElement {
  const node = el("form", attributes, ...children);
  node.addEventListener("submit", (event) => {
    event.preventDefault();
    submitted();
  });
  return node;
}

/** What a view is without the page's server. */
export const unserved = (text: string): HTMLElement => el("p", { class: "unserved" }, ...marked(text));

/** A text with its `code`. */
export function marked(text: string): (HTMLElement | string)[] {
  return text.split("`").map((part, i) => (i % 2 === 1 ? el("code", {}, part) : part));
}

/** Call back for each press of a button that is meant: not for a key's repetitions, nor for the second half of a
 *  double click. */
export function onPress(button: HTMLElement, pressed: () => void): void {
  button.addEventListener("keydown", (event) => event.repeat && event.preventDefault());
  button.addEventListener("click", ({ detail }) => detail < 2 && pressed());
}

/** Natural order: car-2 before car-10. */
export const byName = new Intl.Collator("en", { numeric: true }).compare;

/** A name for what lives no longer than this page. */
export const newName = (): string =>
  Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join(
    "",
  );
