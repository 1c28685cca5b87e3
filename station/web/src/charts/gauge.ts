// A number with a bar: its place between the extremes, and its range of the last 30 seconds.

import { el, Text } from "../base/dom";
import { number } from "../base/format";
import { roundStep } from "./axes";

export interface GaugeOptions {
  readonly name: string;
  readonly label: string;
  readonly unit: string;
  readonly digits: number;
  /** The extremes of the bar; they grow with the values. */
  readonly from: number;
  readonly to: number;
}

export class Gauge {
  readonly node: HTMLElement;
  private readonly value: Text;
  private readonly unit = new Text("unit");
  private readonly low = new Text("num");
  private readonly high = new Text("num");
  private readonly bar = el(
    "div",
    { class: "bar", "aria-hidden": "true" },
    el("span", { class: "band" }),
    el("span", { class: "needle" }),
  );
  private from = 0;
  private to = 1;
  private shown = "";

  constructor(private readonly options: GaugeOptions) {
    const { name, label, unit } = options;
    this.value = new Text("num", "span", { "data-value": name });
    this.unit.set(unit);
    this.node = el(
      "div",
      { class: "gauge", role: "group", "aria-label": label },
      el("p", { class: "gauge-label" }, label),
      el("p", { class: "gauge-value" }, this.value.node, this.unit.node),
      this.bar,
      el("p", { class: "gauge-scale", "aria-hidden": "true" }, this.low.node, this.high.node),
    );
    this.reset();
  }

  /** Reset the extremes for another car. */
  reset(): void {
    [this.from, this.to] = [this.options.from, this.options.to];
  }

  /** Show a value, and the minimum and maximum of the last 30 s. */
  set(
    value: number,
    least: number,
    most: number,
    unit = this.options.unit,
    digits = this.options.digits,
  ): void {
    // The extremes were in another unit before the car's parameters were known.
    if (unit !== this.shown) this.reset();
    this.shown = unit;
    this.value.set(number(value, digits));
    this.unit.set(unit);
    for (const each of [least, value]) if (each < this.from) this.from = roundedOut(each, Math.floor);
    for (const each of [most, value])
      if (each > this.to && each < Infinity) this.to = roundedOut(each, Math.ceil);
    this.low.set(number(this.from, 0));
    this.high.set(number(this.to, 0));
    const place = (at: number): string =>
      `${(Math.max(0, Math.min(1, (at - this.from) / (this.to - this.from))) * 100).toFixed(1)}%`;
    const known = Number.isFinite(value);
    this.bar.style.setProperty("--at", known ? place(value) : "-10%");
    this.bar.style.setProperty("--low", known && least <= most ? place(least) : "0%");
    this.bar.style.setProperty("--high", known && least <= most ? place(most) : "0%");
    this.bar.style.setProperty("--zero", place(0));
  }
}

function roundedOut(value: number, round: (steps: number) => number): number {
  const step = value === 0 ? 1 : roundStep(Math.abs(value) / 4);
  return round(value / step) * step;
}
