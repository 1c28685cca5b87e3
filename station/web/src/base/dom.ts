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

export function setAttribute(node: Element, name: string, value: string): void {
  if (node.getAttribute(name) !== value) node.setAttribute(name, value);
}

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
