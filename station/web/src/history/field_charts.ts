// A chart for each chosen field of a range. All charts share their range and their cursor.

import type { HistoryAnswer } from "../base/contract";
import { el, setAttribute, Text } from "../base/dom";
import { linear, number, type Spec, write } from "../base/format";
import type { Range } from "../base/range";
import { type Hands, type Mark, RangeChart } from "../charts/range_chart";

const FIRST_FIELDS = [
  "speed",
  "voltage_input",
  "current_motor",
  "current_input",
  "duty_cycle",
  "temperature_pcb",
];
const FIRST_CHARTS = 6;
const MOST_CHARTS = 12;

export interface FieldChartsOptions {
  readonly spec: (field: string) => Spec;
  readonly hands: Hands;
  /** The cursor is on another row; null if it has left the charts. */
  readonly onCursor: (index: number | null) => void;
  /** The viewer has chosen other fields. */
  readonly onFields: () => void;
}

interface Shown {
  readonly node: HTMLElement;
  readonly chart: RangeChart;
  readonly band: boolean;
  readonly reading: Text;
  readonly extent: Text;
}

export class FieldCharts {
  readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Fields to chart" });
  readonly node = el("div", { class: "charts three" });
  private readonly shown = new Map<string, Shown>();
  private drive: HistoryAnswer | undefined;
  private range: Range = [0, 1];
  private marks: readonly Mark[] = [];

  constructor(private readonly options: FieldChartsOptions) {}

  /** The charted fields. */
  get fields(): string[] {
    return [...this.shown.keys()];
  }

  /** Chart the fields of an answer that are `wanted`; without one of them, the usual ones. */
  set(drive: HistoryAnswer, fields: readonly string[], range: Range, wanted: readonly string[]): void {
    this.drive = drive;
    this.range = range;
    const charted = fields.filter((field) =>
      drive.fields[field]!.mean.some((value) => typeof value === "number"),
    );
    const usual = FIRST_FIELDS.filter((field) => charted.includes(field));
    const known = wanted.filter((field) => charted.includes(field)).slice(0, MOST_CHARTS);
    const chosen = known.length > 0 ? known : usual.length > 0 ? usual : charted.slice(0, FIRST_CHARTS);
    for (const field of this.fields) if (!chosen.includes(field)) this.remove(field);
    for (const field of chosen) this.update(field);
    this.chips.replaceChildren(
      ...charted.map((field) => {
        const chip = el(
          "button",
          { type: "button", class: "chip", "aria-pressed": String(this.shown.has(field)), title: field },
          this.options.spec(field).label,
        );
        chip.addEventListener("click", () => {
          if (this.shown.has(field)) this.remove(field);
          else if (this.shown.size < MOST_CHARTS) this.update(field);
          setAttribute(chip, "aria-pressed", String(this.shown.has(field)));
          this.options.onFields();
        });
        return chip;
      }),
    );
  }

  clear(): void {
    for (const field of this.fields) this.remove(field);
    this.chips.replaceChildren();
    this.drive = undefined;
  }

  move(range: Range): void {
    this.range = range;
    for (const { chart } of this.shown.values()) chart.move(range);
  }

  /** Mark times on every chart. */
  mark(marks: readonly Mark[]): void {
    this.marks = marks;
    for (const { chart } of this.shown.values()) chart.mark(marks);
  }

  point(index: number): void {
    for (const { chart } of this.shown.values()) chart.point(index);
  }

  /** Show the values of a row in the charts' headings. */
  read(index: number): void {
    for (const [field, { reading }] of this.shown)
      reading.set(write(this.drive?.fields[field]?.mean[index], this.options.spec(field)));
  }

  private remove(field: string): void {
    const shown = this.shown.get(field)!;
    shown.chart.destroy();
    shown.node.remove();
    this.shown.delete(field);
  }

  private update(field: string): void {
    const { times_s, fields, row_s } = this.drive!;
    const { mean, least, most } = fields[field]!;
    const as = this.options.spec(field);
    const scaled = (values: typeof mean): (number | null)[] =>
      values.map((value) => (typeof value === "number" ? linear(value, as) : null));
    const band = least !== undefined && most !== undefined;
    const data = [[...times_s], scaled(mean), ...(band ? [scaled(least), scaled(most)] : [])] as [
      number[],
      ...(number | null)[][],
    ];
    const hole_s = Math.max(1, row_s * 2.5);
    const known = this.shown.get(field);
    const shown = known?.band === band ? known : this.make(field, as, data, band, hole_s);
    if (shown === known) shown.chart.set(data, this.range, hole_s);
    shown.extent.set(extent(band ? [scaled(least), scaled(most)] : [scaled(mean)], as));
  }

  private make(
    field: string,
    { label, unit, digits }: Spec,
    data: [number[], ...(number | null)[][]],
    band: boolean,
    hole_s: number,
  ): Shown {
    const [reading, extent] = [new Text("num", "span", { "data-reading": field }), new Text("note")];
    const plot = el("div", { class: "plot" });
    const value = el("p", { class: "reading" }, reading.node, el("span", { class: "unit" }, unit));
    const node = el(
      "section",
      { class: "panel", "aria-label": label },
      el("header", {}, el("h3", {}, label), extent.node, value),
      plot,
    );
    const old = this.shown.get(field);
    old?.chart.destroy();
    if (old) old.node.replaceWith(node);
    else this.node.append(node);
    const { onCursor, hands } = this.options;
    const about = { title: label, write: (value: number) => `${number(value, digits)} ${unit}` };
    const options = {
      about,
      curves: [{ label, colour: "--accent" }],
      sync: "history",
      hole_s,
      band,
      onCursor,
      hands,
    };
    const shown = { node, chart: new RangeChart(plot, options, data, this.range), band, reading, extent };
    shown.chart.mark(this.marks);
    this.shown.set(field, shown);
    return shown;
  }
}

/** The minimum and maximum of columns. */
function extent(columns: readonly (readonly (number | null)[])[], { digits }: Spec): string {
  let [low, high] = [Infinity, -Infinity];
  for (const value of columns.flat()) {
    if (value === null) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return low > high ? "" : `${number(low, digits)} to ${number(high, digits)}`;
}
