// A heading with the lines' values at the cursor, above a chart of a range.

import type uPlot from "uplot";
import { el, panel, Text } from "../base/dom";
import { number } from "../base/format";
import type { Range } from "../base/range";
import { RangeChart, type RangeChartOptions } from "./range_chart";

export interface LinesPanelOptions extends Omit<RangeChartOptions, "about" | "unit"> {
  readonly title: string;
  readonly unit: string;
  readonly digits: number | undefined;
  /** The unit of x; undefined for a time. */
  readonly along?: string | undefined;
  /** The name of a single line's value, for tests. */
  readonly reading?: string | undefined;
}

/** A column for each line; with a band, the minimum and the maximum of the first one after it. */
export type Columns = readonly (readonly (number | null)[])[];

/** The colour and the dashes of one line among several. */
export const hue = (i: number): string => `hue-${i + 1}`;
export const dash = (i: number): readonly number[] => (i % 2 === 0 ? [] : [6, 3]);
/** A line's sign in a list. */
export const key = (i: number): HTMLElement =>
  el("span", { class: `key ${hue(i)}${i % 2 ? " dashed" : ""}` });

export class LinesPanel {
  readonly node: HTMLElement;
  readonly chart: RangeChart;
  readonly note = new Text("note");
  private readonly readings: readonly Text[];

  constructor(options: LinesPanelOptions, x: readonly number[], columns: Columns, range: Range) {
    const { title, unit, digits, along, reading, ...chart } = options;
    const { curves } = chart;
    this.readings = curves.map(({ label }) =>
      reading === undefined
        ? new Text("num", "span", { "aria-label": label })
        : new Text("num", "span", { "data-reading": reading }),
    );
    const named = curves.length > 1;
    const values = this.readings.map(({ node }, i) =>
      el(
        "p",
        { class: "reading" },
        ...(named ? [key(i), el("span", { class: "label" }, curves[i]!.label)] : []),
        node,
        ...(named ? [] : [el("span", { class: "unit" }, unit)]),
      ),
    );
    const plot = el("div", { class: "plot" });
    // Several lines have one unit, beside the title.
    const first = named ? el("span", { class: "unit" }, unit) : this.note.node;
    this.node = panel(title, "", [first, ...values], plot);
    const about = { title, write: (value: number) => `${number(value, digits)} ${unit}` };
    const more = along === undefined ? {} : { unit: along };
    this.chart = new RangeChart(plot, { ...chart, about, ...more }, dataOf(x, columns), range);
  }

  set(x: readonly number[], columns: Columns, range: Range, hole: number): void {
    this.chart.set(dataOf(x, columns), range, hole);
  }

  read(texts: readonly string[]): void {
    this.readings.forEach((text, i) => text.set(texts[i]!));
  }

  destroy(): void {
    this.chart.destroy();
    this.node.remove();
  }
}

const dataOf = (x: readonly number[], columns: Columns): uPlot.AlignedData => [
  [...x],
  ...columns.map((column) => [...column]),
];
