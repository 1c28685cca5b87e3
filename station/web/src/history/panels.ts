// The panels of a past, or of a comparison: they share their range, their cursor and their marks.

import { button, el, setAttribute } from "../base/dom";
import type { Range } from "../base/range";
import type { Hands, Mark } from "../charts/range_chart";
import { type Arrangeable, Arranged } from "../widgets/arranged";

/** A panel that shows something of the data D. */
export interface Panel<D> extends Arrangeable {
  /** Show the data of a range; false if there is nothing to show. */
  set(data: D, range: Range): boolean;
  /** Show another range of the same data. */
  move(range: Range): void;
  /** Put the cursor where it was at a time, or another place on the x axis. */
  point(at: number): void;
  /** Mark times. */
  mark?(marks: readonly Mark[]): void;
}

/** What a viewer does in a panel. */
export interface Touch extends Hands {
  /** The viewer points at a place on the x axis; null when that ends. */
  readonly point: (at: number | null) => void;
}

export interface PanelsOptions<D> {
  readonly make: (key: string) => Panel<D> | undefined;
  readonly most: number;
  /** The viewer has chosen other panels. */
  readonly changed: () => void;
}

// What is not on the screen follows once nothing has moved for this long.
const SETTLED_MS = 150;

export class Panels<D> extends Arranged<Panel<D>> {
  readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Fields to chart" });
  private data: D | undefined;
  private range: Range = [0, 1];
  private at = NaN;
  private marks: readonly Mark[] = [];
  private readonly outside = new WeakSet<Element>();
  private readonly observer = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) this.outside[isIntersecting ? "delete" : "add"](target);
    this.follow(false);
  });
  /** The panels that show another time than the others, or another range: then it is true. */
  private readonly late = new WeakMap<Panel<D>, boolean>();
  private settling: number | undefined;

  constructor(options: PanelsOptions<D>) {
    super((key) => this.made(options.make(key)), options.most, options.changed);
  }

  /** Show these panels of the data, and offer its fields. */
  show(data: D, range: Range, keys: readonly string[], fields: ReadonlyMap<string, string>): void {
    [this.data, this.range] = [data, range];
    for (const panel of this.panels.values()) this.fill(panel);
    this.set(keys);
    this.chips.replaceChildren(...[...fields].map(([key, label]) => this.chip(key, label)));
    this.refocus();
  }

  clear(): void {
    this.data = undefined;
    this.set([]);
    this.chips.replaceChildren();
  }

  move(range: Range): void {
    this.range = range;
    for (const panel of this.panels.values()) if (this.due(panel, true)) panel.move(range);
  }

  mark(marks: readonly Mark[]): void {
    this.marks = marks;
    for (const panel of this.panels.values()) panel.mark?.(marks);
  }

  point(at: number): void {
    this.at = at;
    for (const panel of this.panels.values())
      if (!panel.node.hidden && this.due(panel, false)) panel.point(at);
  }

  override set(keys: readonly string[]): void {
    super.set(keys);
    for (const chip of this.chips.children)
      setAttribute(chip, "aria-pressed", String(this.keys.includes((chip as HTMLElement).title)));
  }

  private made(panel: Panel<D> | undefined): Panel<D> | undefined {
    if (panel) this.fill(panel);
    if (panel) this.observer.observe(panel.node);
    return panel;
  }

  /** Whether a panel follows now: on the screen it does, elsewhere later. */
  private due(panel: Panel<D>, moved: boolean): boolean {
    if (!this.outside.has(panel.node)) return true;
    this.late.set(panel, moved || (this.late.get(panel) ?? false));
    window.clearTimeout(this.settling);
    this.settling = window.setTimeout(() => this.follow(true), SETTLED_MS);
    return false;
  }

  /** Let the panels follow that are late: `all` of them, or those that have come onto the screen. */
  private follow(all: boolean): void {
    for (const panel of this.panels.values()) {
      const moved = this.late.get(panel);
      if (moved === undefined || (!all && this.outside.has(panel.node))) continue;
      this.late.delete(panel);
      if (moved) panel.move(this.range);
      if (!panel.node.hidden) panel.point(this.at);
    }
  }

  private fill(panel: Panel<D>): void {
    if (this.data === undefined) return;
    this.late.delete(panel);
    panel.node.hidden = !panel.set(this.data, this.range);
    if (panel.node.hidden) return;
    panel.mark?.(this.marks);
    panel.point(this.at);
  }

  private chip(key: string, label: string): HTMLElement {
    const pressed = String(this.keys.includes(key));
    return button(label, () => this.toggle(key), { class: "chip", title: key, "aria-pressed": pressed });
  }
}

/** The keys that are wanted and there; without one of them the usual ones, or the first. */
export function chosen(
  all: readonly string[],
  wanted: readonly string[],
  usual: readonly string[],
  first: number,
): readonly string[] {
  const known = [wanted, usual].map((keys) => keys.filter((key) => all.includes(key)));
  return known.find((keys) => keys.length > 0) ?? all.slice(0, first);
}
