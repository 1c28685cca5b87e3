// What is chosen for a car's charts: window and charts, kept in this browser and in the address.

import type { FieldTable } from "../base/contract";
import { button, choices, el, form } from "../base/dom";
import { spec } from "../base/format";
import { keep, kept } from "../base/kept";
import type { Query } from "../base/route";
import { WINDOWS, windowLabel } from "../charts/windows";
import type { Robot } from "../live/robot";
import type { Board } from "./board";
import { fieldKey } from "./board_panels";
import { BOARD } from "./car_charts";

const EVERY = [...BOARD.keys()].join(",");

export class BoardTools {
  readonly node: HTMLElement;
  window_s: number = WINDOWS[0];
  private readonly window = el(
    "select",
    { name: "window" },
    ...choices([...WINDOWS].sort((a, b) => a - b).map((each) => [String(each), windowLabel(each)] as const)),
  );
  private readonly more = el("select", { name: "chart", "aria-label": "Add a chart" });
  private readonly reset = button("Reset", () => this.choose(WINDOWS[0], EVERY));
  private charts = EVERY;
  private robot: Robot | undefined;

  constructor(
    private readonly board: Board,
    private readonly table: FieldTable,
    private readonly changed: () => void,
  ) {
    const last = el("label", {}, "Last ", this.window);
    this.node = form({ class: "range board-tools" }, () => undefined, last, this.more, this.reset);
    this.window.addEventListener("input", () => this.choose(Number(this.window.value), this.charts));
    this.more.addEventListener("input", () => board.toggle(this.more.value));
    // Made when it is needed: a car may have hundreds of fields, and new ones at any time.
    for (const event of ["pointerdown", "focus"]) this.more.addEventListener(event, () => this.offer());
    this.offer();
  }

  /** What differs from a first visit, for the address. */
  get query(): Query<"car"> {
    const told = <T>(value: T, plain: T): T | undefined => (value === plain ? undefined : value);
    return { window: told(String(this.window_s), String(WINDOWS[0])), charts: told(this.charts, EVERY) };
  }

  /** Take the address's choices, or the ones of the last visit. A link changes nothing that is kept. */
  read({ window = kept("car.window"), charts = kept("car.charts") }: Query<"car">): void {
    this.apply(Number(window), charts ?? EVERY);
  }

  /** Offer this car's fields. */
  of(robot: Robot | undefined): void {
    this.robot = robot;
  }

  /** The board was changed by hand. */
  arranged(): void {
    this.choose(this.window_s, this.board.keys.join(","));
  }

  private choose(window_s: number, charts: string): void {
    keep("car.window", String(window_s));
    keep("car.charts", charts);
    this.apply(window_s, charts);
    this.changed();
  }

  private apply(window_s: number, charts: string): void {
    this.window_s = WINDOWS.find((each) => each === window_s) ?? WINDOWS[0];
    this.window.value = String(this.window_s);
    this.board.span(this.window_s);
    if (charts !== this.board.keys.join(",")) this.board.set(charts.split(","));
    this.charts = this.board.keys.join(",");
    this.reset.hidden = Object.values(this.query).every((value) => value === undefined);
  }

  /** Offer the charts that are not shown, and the numbers of every stream. */
  private offer(): void {
    const shown = new Set(this.board.keys);
    const group = (label: string, of: readonly (readonly [value: string, text: string])[]): HTMLElement[] => {
      const others = of.filter(([value]) => !shown.has(value));
      return others.length > 0 ? [el("optgroup", { label }, ...choices(others))] : [];
    };
    const streams = [...(this.robot?.streams.values() ?? [])];
    const first = el("option", { value: "", selected: "", disabled: "", hidden: "" }, "Add a chart");
    const charts = [...BOARD].map(([key, { title }]) => [key, title] as const);
    const fields = streams.flatMap(({ name, columns, ros2 }) => {
      const label = (field: string): string => spec(field, this.table, ros2, name).label;
      return group(
        name,
        [...columns.keys()].map((field) => [fieldKey(name, field), label(field)] as const),
      );
    });
    this.more.replaceChildren(first, ...group("Charts", charts), ...fields);
    first.selected = true;
  }
}
