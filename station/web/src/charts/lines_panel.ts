// A heading with the lines' values at the cursor, above a chart of a range. It may show other lines, and stays.

import type uPlot from "uplot";
import { el, panel, Text } from "../base/dom";
import { AS_SENT, number, type Spec, write } from "../base/format";
import type { Range } from "../base/range";
import { type Mark, RangeChart, type RangeChartOptions, type Threshold } from "./range_chart";
import { extremes, valueAt } from "./spoken";

/** A column for each line; with a band, the minimum and the maximum of the first one after it. What is undefined is a
 *  row of another line. */
export type Columns = readonly (readonly (number | null | undefined)[])[];

/** A line, and how its values are written: those of the columns are as they are shown. */
export interface Line
  extends Pick<Spec, "label" | "unit" | "digits">,
    Partial<Pick<Spec, "texts" | "time">> {}

export interface Lines {
  readonly x: readonly number[];
  /** The unit of x; undefined for a time. */
  readonly along?: string | undefined;
  /** A line has a gap after this much of x without a value. */
  readonly hole: number;
  readonly columns: Columns;
  readonly lines: readonly Line[];
}

export interface LinesPanelOptions extends Pick<RangeChartOptions, "hands" | "sync" | "onCursor" | "zero"> {
  readonly title: string;
  /** The name of a single line's value, for tests. */
  readonly reading?: string;
}

/** The colour and the dashes of one line among several. */
export const hue = (i: number): string => `hue-${i + 1}`;
export const dash = (i: number): readonly number[] => (i % 2 === 0 ? [] : [6, 3]);
/** A line's sign in a list. */
export const key = (i: number): HTMLElement =>
  el("span", { class: `key ${hue(i)}${i % 2 ? " dashed" : ""}` });

export class LinesPanel {
  readonly node: HTMLElement;
  /** What stands beside the readings. */
  readonly aside = el("span", { class: "panel-tools" });
  private readonly heading = el("span", { class: "readings" });
  private readonly note = new Text("note");
  private plot = el("div", { class: "plot" });
  private chart: RangeChart | undefined;
  private readings: readonly Text[] = [];
  private shown: Lines = { x: [], hole: 1, columns: [], lines: [] };
  private kind = "";
  private marks: readonly Mark[] = [];
  private threshold: Threshold | undefined;

  constructor(private readonly options: LinesPanelOptions) {
    this.node = panel(
      options.title,
      "",
      [this.heading, this.aside],
      el("div", { class: "plot-box" }, this.plot),
    );
  }

  /** Draw lines: in the chart that is there, if they are of the same kind. */
  draw(lines: Lines, range: Range): void {
    const { x, along, hole, columns } = lines;
    const data: uPlot.AlignedData = [
      [...x],
      ...columns.map((column) => [...column]),
    ] as unknown as uPlot.AlignedData;
    const kind = JSON.stringify([lines.lines, columns.length, along]);
    this.shown = lines;
    if (this.chart && kind === this.kind) this.chart.set(data, range, hole);
    else this.rebuild(lines, data, range);
    this.kind = kind;
    if (lines.lines.length > 1 || columns.length === 0) return;
    const band = columns.length > 1;
    const [low, high] = [extremes(columns[band ? 1 : 0]!).least, extremes(columns[band ? 2 : 0]!).most];
    const { digits } = lines.lines[0]!;
    this.note.set(low > high ? "" : `${number(low, digits)} to ${number(high, digits)}`);
  }

  move(range: Range): void {
    this.chart?.move(range);
  }

  mark(marks: readonly Mark[]): void {
    this.marks = marks;
    this.chart?.mark(marks);
  }

  /** Put the cursor on a row, and show its values. */
  point(index: number): void {
    this.chart?.point(index);
    this.read(index);
  }

  /** Show a threshold that the viewer drags. */
  limit(threshold: Threshold | undefined): void {
    this.threshold = threshold;
    if (this.chart) this.chart.limit = threshold;
  }

  /** Show the values of a row in the heading. */
  read(index: number): void {
    this.readings.forEach((text, i) => {
      const spec = { ...this.shown.lines[i]!, ...AS_SENT, meaning: "" };
      text.set(write(valueAt(this.shown.columns[i] ?? [], index), spec));
    });
  }

  destroy(): void {
    this.chart?.destroy();
    this.node.remove();
  }

  private rebuild({ along, hole, columns, lines }: Lines, data: uPlot.AlignedData, range: Range): void {
    const { title, reading, ...options } = this.options;
    const named = lines.length > 1;
    // Lines of one unit have it beside the title; others have theirs beside each value.
    const units = [...new Set(lines.map(({ unit }) => unit))];
    this.readings = lines.map(({ label }) =>
      named || reading === undefined
        ? new Text("num", "span", { "aria-label": label })
        : new Text("num", "span", { "data-reading": reading }),
    );
    const values = this.readings.map(({ node }, i) =>
      el(
        "p",
        { class: "reading" },
        ...(named ? [key(i), el("span", { class: "label" }, lines[i]!.label)] : []),
        node,
        ...(named && units.length === 1 ? [] : [el("span", { class: "unit" }, lines[i]!.unit)]),
      ),
    );
    const first = named ? el("span", { class: "unit" }, units.length === 1 ? units[0]! : "") : this.note.node;
    this.heading.replaceChildren(first, ...values);
    this.node.dataset.lines = named ? "several" : "one";
    const plot = el("div", { class: "plot" });
    this.plot.replaceWith(plot);
    this.plot = plot;
    this.chart?.destroy();
    const write = (value: number, i = 0): string =>
      `${number(value, lines[i]!.digits)} ${lines[i]!.unit}`.trim();
    const curves = lines.map(({ label, unit }, i) => ({
      label,
      colour: named ? `--${hue(i)}` : "--accent",
      dash: named ? dash(i) : [],
      right: unit !== units[0],
    }));
    const more = along === undefined ? {} : { unit: along };
    const band = columns.length > lines.length;
    this.chart = new RangeChart(
      plot,
      { ...options, ...more, curves, band, hole_s: hole, about: { title, write } },
      data,
      range,
    );
    this.chart.mark(this.marks);
    this.chart.limit = this.threshold;
  }
}
