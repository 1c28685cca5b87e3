// A car's charts, which the viewer chooses and arranges: drag a chart by its grip, or move it with the arrow keys.

import type { FieldTable, TrackMap } from "../base/contract";
import { button, el } from "../base/dom";
import type { Linear } from "../base/format";
import { WINDOWS } from "../charts/windows";
import type { Robot } from "../live/robot";
import { type BoardPanel, panelOf } from "./board_panels";
import { BOARD } from "./car_charts";

const MOST = 24;
const STEPS: Readonly<Record<string, number>> = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 };

export class Board {
  readonly node = el("div", { class: "charts" });
  private readonly panels = new Map<string, BoardPanel>();
  private order: string[] = [];
  private window_s: number = WINDOWS[0];

  constructor(
    private readonly table: FieldTable,
    private readonly track: TrackMap | null,
    private readonly changed: () => void,
  ) {
    this.set([...BOARD.keys()]);
  }

  /** The keys of the charts, in their order. */
  get charts(): readonly string[] {
    return this.order;
  }

  /** Show these charts, in this order. */
  set(keys: readonly string[]): void {
    const chosen = [...new Set(keys)].slice(0, MOST);
    for (const [key, panel] of this.panels) {
      if (chosen.includes(key)) continue;
      panel.node.remove();
      panel.destroy();
      this.panels.delete(key);
    }
    this.order = chosen.filter((key) => this.panels.has(key) || this.add(key));
    this.node.append(...this.order.map((key) => this.panels.get(key)!.node));
  }

  /** Add a chart, or remove it. */
  toggle(key: string): void {
    const shown = this.panels.has(key);
    this.set(shown ? this.order.filter((each) => each !== key) : [...this.order, key]);
    if (!shown) this.panels.get(key)?.node.scrollIntoView({ block: "nearest" });
    this.changed();
  }

  span(window_s: number): void {
    this.window_s = window_s;
    for (const panel of this.panels.values()) panel.span(window_s);
  }

  values(robot: Robot, speed: Linear | undefined): void {
    for (const panel of this.panels.values()) panel.node.hidden = !panel.values(robot, speed);
  }

  draw(now: number): void {
    const panels = [...this.panels.values()].filter(({ node }) => !node.hidden);
    // All in the same frame: a frame costs more than its charts.
    if (panels.some((panel) => panel.due(now))) for (const panel of panels) panel.draw(now);
  }

  private add(key: string): boolean {
    const panel = panelOf(key, this.table, this.track);
    if (!panel) return false;
    panel.span(this.window_s);
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
    if (to >= 0) this.move(key, to);
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
    this.move(key, this.order.indexOf(next));
    this.changed();
  }

  /** Put a chart at another's place. Its own node stays where it is, or it would lose the pointer and the keyboard. */
  private move(key: string, to: number): void {
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
