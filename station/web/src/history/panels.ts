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
// A frame that took longer had too many panels to draw. The panel under the pointer and another one are always drawn.
const SLOW_MS = 25;
const LEAST_PER_FRAME = 2;

export class Panels<D> extends Arranged<Panel<D>> {
  readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Fields to chart" });
  private data: D | undefined;
  private range: Range = [0, 1];
  private at = NaN;
  private marks: readonly Mark[] = [];
  private readonly outside = new WeakSet<Element>();
  private readonly observer = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) this.outside[isIntersecting ? "delete" : "add"](target);
    this.followSoon();
  });
  /** The panels that show another time than the others, or another range, which is true then: the latest last. */
  private readonly late = new Map<Panel<D>, boolean>();
  private following: number | undefined;
  private settling: number | undefined;
  /** How many panels are drawn in a frame, and when the last ones were. */
  private perFrame = Infinity;
  private drawnAt = NaN;

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

  /** Show another range, with the next frames. */
  move(range: Range): void {
    this.range = range;
    for (const panel of this.panels.values()) this.late.set(panel, true);
    this.followSoon();
  }

  mark(marks: readonly Mark[]): void {
    this.marks = marks;
    for (const panel of this.panels.values()) panel.mark?.(marks);
  }

  point(at: number): void {
    this.at = at;
    for (const panel of this.panels.values())
      if (this.outside.has(panel.node)) this.late.set(panel, this.late.get(panel) ?? false);
      else if (!panel.node.hidden) panel.point(at);
    if (this.late.size > 0) this.followSoon();
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

  private followSoon(): void {
    this.following ??= requestAnimationFrame((now) => {
      this.following = undefined;
      this.follow(now);
    });
  }

  /** Let late panels follow: on the screen as many as a frame has time for, by turns; elsewhere at rest. */
  private follow(now: number): void {
    const took = now - this.drawnAt;
    if (took > SLOW_MS)
      this.perFrame = Math.max(LEAST_PER_FRAME, Math.min(this.perFrame, this.panels.size) / 2);
    else if (took <= SLOW_MS) this.perFrame = Math.min(this.panels.size, this.perFrame + 0.1);
    const seen = [...this.late.keys()].filter(({ node }) => !this.outside.has(node));
    const pointed = seen.filter(({ node }) => node.matches(":hover"));
    for (const panel of [...new Set([...pointed, ...seen])].slice(0, this.perFrame)) this.catchUp(panel);
    this.drawnAt = seen.length > 0 ? now : NaN;
    // Once more, to see how long these took.
    if (seen.length > 0) this.followSoon();
    else if (this.late.size > 0) {
      window.clearTimeout(this.settling);
      this.settling = window.setTimeout(() => {
        for (const panel of this.late.keys()) this.catchUp(panel);
      }, SETTLED_MS);
    }
  }

  private catchUp(panel: Panel<D>): void {
    const moved = this.late.get(panel);
    this.late.delete(panel);
    // It may have been closed meanwhile.
    if (!panel.node.isConnected) return;
    if (moved) panel.move(this.range);
    if (!panel.node.hidden) panel.point(this.at);
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
