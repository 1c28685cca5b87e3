// A chart for each chosen field, with a line for each part. All charts share their range and their cursor.

import { el, setAttribute, Text } from "../base/dom";
import { number, type Spec, write } from "../base/format";
import type { Range } from "../base/range";
import { type Hands, RangeChart } from "../charts/range_chart";

const FIRST_FIELDS = ["speed", "current_motor", "duty_cycle", "voltage_input"];
const MOST_CHARTS = 8;

/** The parts' values of the fields, on a common grid. */
export interface Compared {
  readonly grid: readonly number[];
  /** The unit of the grid. */
  readonly unit: string;
  readonly fields: ReadonlyMap<string, readonly (readonly (number | null)[])[]>;
}

export const hue = (i: number): string => `hue-${i + 1}`;
export const dash = (i: number): readonly number[] => (i % 2 === 0 ? [] : [6, 3]);

interface Shown {
  readonly node: HTMLElement;
  readonly chart: RangeChart;
  readonly readings: readonly Text[];
}

export class CompareCharts {
  readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Fields to chart" });
  readonly node = el("div", { class: "charts" });
  private readonly shown = new Map<string, Shown>();
  private data: Compared = { grid: [], unit: "s", fields: new Map() };
  private range: Range = [0, 1];

  constructor(
    private readonly spec: (field: string) => Spec,
    private readonly hands: Hands,
    private readonly onCursor: (index: number | null) => void,
    private readonly onFields: () => void,
  ) {}

  get fields(): string[] {
    return [...this.shown.keys()];
  }

  set(data: Compared, names: readonly string[], range: Range, wanted: readonly string[]): void {
    this.data = data;
    this.range = range;
    for (const field of this.fields) this.remove(field);
    const all = [...data.fields.keys()];
    const known = [wanted, FIRST_FIELDS]
      .map((list) => list.filter((field) => all.includes(field)))
      .find((list) => list.length > 0);
    for (const field of (known ?? all.slice(0, 4)).slice(0, MOST_CHARTS)) this.add(field, names);
    this.chips.replaceChildren(
      ...all.map((field) => {
        const chip = el(
          "button",
          { type: "button", class: "chip", "aria-pressed": String(this.shown.has(field)), title: field },
          this.spec(field).label,
        );
        chip.addEventListener("click", () => {
          if (this.shown.has(field)) this.remove(field);
          else if (this.shown.size < MOST_CHARTS) this.add(field, names);
          setAttribute(chip, "aria-pressed", String(this.shown.has(field)));
          this.onFields();
        });
        return chip;
      }),
    );
  }

  move(range: Range): void {
    this.range = range;
    for (const { chart } of this.shown.values()) chart.move(range);
  }

  read(index: number): void {
    for (const [field, { readings }] of this.shown) {
      const spec = { ...this.spec(field), scale: 1, shift: 0 };
      readings.forEach((text, i) => text.set(write(this.data.fields.get(field)?.[i]?.[index], spec)));
    }
  }

  private remove(field: string): void {
    this.shown.get(field)?.chart.destroy();
    this.shown.get(field)?.node.remove();
    this.shown.delete(field);
  }

  private add(field: string, names: readonly string[]): void {
    const columns = this.data.fields.get(field)!;
    const { label, unit, digits } = this.spec(field);
    const readings = names.map((name) => new Text("num", "span", { "aria-label": name }));
    const plot = el("div", { class: "plot" });
    const values = readings.map(({ node }, i) =>
      el(
        "p",
        { class: "reading" },
        el("span", { class: `key ${hue(i)}${i % 2 ? " dashed" : ""}` }),
        el("span", { class: "label" }, names[i]!),
        node,
      ),
    );
    const node = el(
      "section",
      { class: "panel", "aria-label": label },
      el("header", {}, el("h3", {}, label, " ", el("span", { class: "unit" }, unit)), ...values),
      plot,
    );
    this.node.append(node);
    const curves = names.map((name, i) => ({ label: name, colour: `--${hue(i)}`, dash: dash(i) }));
    const chart = new RangeChart(
      plot,
      {
        about: { title: label, write: (value) => `${number(value, digits)} ${unit}` },
        curves,
        sync: "compare",
        hole_s: Infinity,
        unit: this.data.unit,
        hands: this.hands,
        onCursor: this.onCursor,
      },
      [[...this.data.grid], ...columns.map((column) => [...column])] as [number[], ...(number | null)[][]],
      this.range,
    );
    this.shown.set(field, { node, chart, readings });
  }
}
