// A heading with readings above a live chart. While the pointer is on the chart, the readings are of its time.

import { el, panel, setAttribute, Text } from "../base/dom";
import { AS_SENT, age, type Linear, linear, number } from "../base/format";
import { LiveChart, type LiveChartOptions, type Shown } from "./live_chart";

/** A value in a panel's heading, computed from the values of the panel's lines. */
export interface Reading {
  readonly name: string;
  readonly label?: string;
  readonly unit: string;
  readonly digits?: number;
  /** The line whose colour is shown beside the value. */
  readonly line?: number;
  readonly from: (values: readonly number[]) => number;
}

export interface ChartPanelOptions {
  readonly title: string;
  readonly readings: readonly Reading[];
  readonly chart: Omit<LiveChartOptions, "about">;
}

export class ChartPanel {
  readonly node: HTMLElement;
  readonly title: string;
  private readonly texts: Text[];
  private readonly note = new Text("note");
  private readonly chart: LiveChart;
  private readonly units: Text[];
  private hovered = false;
  private as: Linear = AS_SENT;
  private digits: number | undefined;

  constructor(private readonly options: ChartPanelOptions) {
    const { title, readings, chart } = options;
    this.title = title;
    this.texts = readings.map(({ name }) => new Text("num", "span", { "data-reading": name }));
    this.units = readings.map(({ unit }) => {
      const text = new Text("unit");
      text.set(unit);
      return text;
    });
    const values = readings.map(({ label, line }, i) =>
      el(
        "p",
        { class: "reading" },
        ...(line === undefined ? [] : [el("span", { class: `key ${chart.lines[line]!.colour.slice(2)}` })]),
        ...(label ? [el("span", { class: "label" }, label)] : []),
        this.texts[i]!.node,
        this.units[i]!.node,
      ),
    );
    const plot = el("div", { class: "plot" });
    this.node = panel(title, "", [this.note.node, ...values], plot);
    this.chart = new LiveChart(plot, {
      ...chart,
      about: {
        title,
        lines: chart.lines.map((_, i) => readings.find(({ line }) => line === i)?.label ?? ""),
        write: (value) =>
          `${number(value, this.digits ?? readings[0]?.digits)} ${this.units[0]?.node.textContent ?? ""}`,
      },
      onPoint: (point) => {
        this.hovered = point !== undefined;
        setAttribute(this.node, "data-hover", String(this.hovered));
        if (point) {
          this.read(point.values);
          this.note.set(`${age(point.ago)} ago`);
        }
      },
    });
  }

  /** Set the data, its scale, and the unit and the digits if they differ. */
  show(shown: Shown | undefined, as: Linear, unit?: string, digits?: number): void {
    [this.as, this.digits] = [as, digits];
    this.chart.show(shown, as);
    this.options.readings.forEach((reading, i) => this.units[i]!.set(unit ?? reading.unit));
  }

  update(values: readonly number[]): void {
    if (this.hovered) return;
    this.read(values.map((value) => linear(value, this.as)));
    this.note.set("");
    this.chart.wake();
  }

  span(window_s: number): void {
    this.chart.span(window_s);
  }

  destroy(): void {
    this.chart.destroy();
  }

  due(now: number): boolean {
    return this.chart.due(now);
  }

  draw(now: number): void {
    this.chart.draw(now);
  }

  private read(values: readonly number[]): void {
    this.options.readings.forEach(({ digits, from }, i) =>
      this.texts[i]!.set(number(from(values), this.digits ?? digits)),
    );
  }
}
