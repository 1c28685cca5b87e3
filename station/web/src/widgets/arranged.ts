// Panels that the viewer chooses and arranges: drag one by its grip, or move it with the arrow keys.

import { button, el } from "../base/dom";

/** What can be arranged. Its node has a header, which gets the grip and the cross. */
export interface Arrangeable {
  readonly title: string;
  readonly node: HTMLElement;
  destroy(): void;
}

const STEPS: Readonly<Record<string, number>> = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 };

export class Arranged<P extends Arrangeable> {
  readonly node = el("div", { class: "charts" });
  protected readonly panels = new Map<string, P>();
  private order: string[] = [];
  /** The list that had the focus when its panel was swapped. */
  private lost: { readonly key: string; readonly name: string } | undefined;

  /** `make` is undefined for a key that is none; `changed` is called after a change by hand. */
  constructor(
    private readonly make: (key: string) => P | undefined,
    private readonly most: number,
    private readonly changed: () => void,
  ) {}

  /** The panels' keys, in their order. */
  get keys(): readonly string[] {
    return this.order;
  }

  /** Show these panels, in this order. */
  set(keys: readonly string[]): void {
    const chosen = [...new Set(keys)].slice(0, this.most);
    for (const [key, panel] of this.panels) {
      if (chosen.includes(key)) continue;
      panel.node.remove();
      panel.destroy();
      this.panels.delete(key);
    }
    this.order = chosen.filter((key) => this.panels.has(key) || this.add(key));
    const nodes = this.order.map((key) => this.panels.get(key)!.node);
    // A node that is moved loses the focus.
    if (nodes.some((node, i) => node !== this.node.children[i])) this.node.append(...nodes);
  }

  /** Add a panel, or remove it. */
  toggle(key: string): void {
    const shown = this.panels.has(key);
    this.set(shown ? this.order.filter((each) => each !== key) : [...this.order, key]);
    this.changed();
    if (!shown) this.panels.get(key)?.node.scrollIntoView({ block: "nearest" });
  }

  /** Put another panel into the place of one, with the focus on the same list. */
  swap(from: string, to: string): void {
    const focused = this.panels.get(from)?.node.contains(document.activeElement) ?? false;
    const name = document.activeElement?.getAttribute("aria-label");
    this.set(this.order.filter((key) => key !== to).map((key) => (key === from ? to : key)));
    this.changed();
    this.lost = focused && name ? { key: to, name } : undefined;
    this.refocus();
  }

  /** Give the focus back to the list of a panel that was swapped, once that is shown. */
  protected refocus(): void {
    const node = this.lost && this.panels.get(this.lost.key)?.node;
    if (!node || node.hidden) return;
    const { name } = this.lost!;
    [...node.querySelectorAll("select")].find((list) => list.getAttribute("aria-label") === name)?.focus();
    this.lost = undefined;
  }

  private add(key: string): boolean {
    const panel = this.make(key);
    if (!panel) return false;
    const grip = button("\u283f", undefined, {
      class: "grip",
      "aria-label": `Move ${panel.title}`,
      title: "Drag, or press the arrow keys",
    });
    const close = button("×", () => this.toggle(key), {
      class: "close",
      "aria-label": `Close ${panel.title}`,
    });
    grip.addEventListener("keydown", (event) => this.step(event, key));
    grip.addEventListener("pointerdown", (event) => grip.setPointerCapture(event.pointerId));
    grip.addEventListener(
      "pointermove",
      (event) => grip.hasPointerCapture(event.pointerId) && this.drag(event, key),
    );
    grip.addEventListener("lostpointercapture", () => this.changed());
    const header = panel.node.querySelector("header")!;
    header.prepend(grip);
    header.append(close);
    this.panels.set(key, panel);
    return true;
  }

  private drag({ clientX, clientY }: PointerEvent, key: string): void {
    const over = document.elementFromPoint(clientX, clientY)?.closest(".panel");
    const to = this.order.findIndex((each) => this.panels.get(each)!.node === over);
    if (to >= 0) this.place(key, to);
  }

  private step(event: KeyboardEvent, key: string): void {
    const step = STEPS[event.key];
    if (step === undefined) return;
    // The page's own arrow keys change the car.
    event.stopPropagation();
    event.preventDefault();
    const shown = this.order.filter((each) => !this.panels.get(each)!.node.hidden);
    const next = shown[shown.indexOf(key) + step];
    if (next === undefined) return;
    this.place(key, this.order.indexOf(next));
    this.changed();
  }

  /** Put a panel at another's place. Its own node stays where it is, or it would lose the pointer and the keyboard. */
  private place(key: string, to: number): void {
    const from = this.order.indexOf(key);
    if (from === to) return;
    this.order.splice(to, 0, ...this.order.splice(from, 1));
    const node = this.panels.get(key)!.node;
    const nodes = this.order.map((each) => this.panels.get(each)!.node);
    const at = nodes.indexOf(node);
    node.before(...nodes.slice(0, at));
    node.after(...nodes.slice(at + 1));
  }
}
