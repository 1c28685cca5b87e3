// CloudWatch's deployed dashboards, drawn from the cloud's metrics.

import type { Alarm, Dashboard, DashboardsAnswer, Series, Widget } from "../base/contract";
import { choices, el, panel, Text, unserved } from "../base/dom";
import { NOTHING, number, when } from "../base/format";
import { route } from "../base/route";
import { type Curve, RangeChart } from "../charts/range_chart";
import { ask, Latest } from "../server/answers";
import { LogTable } from "../widgets/log_table";
import { type Services, type View, viewNode } from "./view";

const REFRESH_S = 30;
const RANGES = [
  ["15", "15 min"],
  ["60", "1 h"],
  ["180", "3 h"],
  ["1440", "24 h"],
] as const;
const UNSERVED =
  "This page was put on the web as it is, and cannot read CloudWatch. Run `iort dashboard`, or look at them in the AWS console.";
const COLOURS = ["--hue-1", "--hue-2", "--hue-3", "--hue-4", "--hue-5", "--hue-6"];
const DASHES = [undefined, [6, 3], [2, 3]] as const;

export class CloudWatchView implements View {
  readonly node: HTMLElement;
  private readonly choice = el("select", { id: "dashboard", name: "dashboard" });
  private readonly range = el("select", { id: "minutes", name: "minutes" }, ...choices(RANGES));
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly grid = el("div", { class: "widgets" });
  private charts: RangeChart[] = [];
  private logs = new Map<string, LogTable>();
  private timer: number | undefined;
  private readonly loading = new Latest();

  constructor(private readonly services: Services) {
    const { config } = services;
    this.range.value = "60";
    for (const each of [this.choice, this.range]) each.addEventListener("change", () => void this.load());
    const form = el(
      "p",
      { class: "range" },
      el("label", {}, "dashboard ", this.choice),
      el("label", {}, "last ", this.range),
    );
    const served = config.answers ? [form, this.grid] : [unserved(UNSERVED)];
    this.node = viewNode("cloudwatch", "CloudWatch", [this.note.node], ...served);
  }

  title(): string {
    return "CloudWatch · iort";
  }

  show(): void {
    this.rest();
    if (!this.services.config.answers) return;
    void this.find();
    this.timer = window.setInterval(() => !document.hidden && void this.load(), REFRESH_S * 1000);
  }

  leave(): void {
    this.rest();
    for (const log of this.logs.values()) log.stop();
  }

  private rest(): void {
    window.clearInterval(this.timer);
    this.loading.stop();
  }

  private async find(): Promise<void> {
    this.note.set("Loading …");
    await this.loading.run(
      async (signal) => {
        const { dashboards } = await ask<DashboardsAnswer>("dashboards", {}, signal);
        const before = this.choice.value;
        this.choice.replaceChildren(...choices(dashboards));
        if (dashboards.includes(before)) this.choice.value = before;
        if (dashboards.length === 0) this.note.set("No dashboard is deployed.");
        else void this.load();
      },
      (reason) => this.note.set(reason),
    );
  }

  private async load(): Promise<void> {
    if (!this.choice.value) return;
    const asked = { name: this.choice.value, minutes: this.range.value };
    await this.loading.run(
      async (signal) => {
        this.draw(await ask<Dashboard>("dashboard", asked, signal));
        // The dashboard ends with the current minute.
        this.note.set(`as of ${when(Date.now() / 1000)}, again every ${REFRESH_S} s`);
      },
      (reason) => this.note.set(reason),
    );
  }

  private draw({ name, widgets, from_s, to_s }: Dashboard): void {
    for (const chart of this.charts) chart.destroy();
    this.charts = [];
    const logs = new Map<string, LogTable>();
    const ordered = [...widgets].sort((a, b) => a.y - b.y || a.x - b.x);
    this.grid.replaceChildren(
      ...ordered.map((widget) => {
        const [node, plot] = frame(widget);
        node.style.setProperty("--across", String(widget.width));
        node.style.setProperty("--down", String(widget.height));
        if (plot) queueMicrotask(() => this.charts.push(chart(plot, widget, [from_s, to_s])));
        if (widget.kind === "log") {
          const asked = { name, widget: String(widget.number), minutes: this.range.value };
          const key = JSON.stringify(asked);
          const log = this.logs.get(key) ?? new LogTable(asked, widget.title);
          logs.set(key, log);
          node.append(log.node);
          void log.refresh();
        }
        return node;
      }),
    );
    for (const [key, log] of this.logs) if (!logs.has(key)) log.stop();
    this.logs = logs;
  }
}

function frame(widget: Widget): [HTMLElement, HTMLElement | undefined] {
  if (widget.kind === "text")
    return [el("section", { class: "widget words" }, ...markdown(widget.text)), undefined];
  const { title, kind, alarms, series } = widget;
  const raised = alarms.filter(({ state }) => state === "ALARM").length;
  const count = `${raised === 0 ? "none" : raised} of ${alarms.length} raised`;
  const node = panel(title, "widget", kind === "alarms" ? [el("span", { class: "note" }, count)] : []);
  node.dataset.widget = node.querySelector("h3")!.title = title;
  const legend = el("ul", { class: "legend" }, ...series.map(legendItem));
  if (kind === "other") node.append(el("p", { class: "note" }, widget.text));
  if (kind === "alarms")
    node.append(el("ul", { class: "alarms" }, ...[...alarms].sort(byUrgency).map(alarm)));
  if (kind === "number") node.append(legend);
  if (kind !== "series") return [node, undefined];
  const any = series.some(({ values }) => values.length > 0);
  const plot = el("div", { class: "plot", ...(any ? {} : { "data-empty": "no data in this range" }) });
  node.append(plot, legend);
  return [node, plot];
}

function legendItem({ label, values }: Series, i: number): HTMLElement {
  const newest = values.at(-1);
  return el(
    "li",
    { "data-series": label },
    el("span", { class: `key ${COLOURS[i % COLOURS.length]!.slice(2)}` }),
    label,
    " ",
    el("b", { class: "num" }, newest === undefined ? NOTHING : number(newest, digits(newest))),
  );
}

const STATES = { ALARM: "raised", INSUFFICIENT_DATA: "no data yet", OK: "quiet" } as const;

function byUrgency(a: Alarm, b: Alarm): number {
  const order = Object.keys(STATES);
  return order.indexOf(a.state) - order.indexOf(b.state);
}

function alarm({ name, about, state, reason, since_s }: Alarm): HTMLElement {
  const since = `${STATES[state]} since ${when(since_s)}`;
  return el(
    "li",
    { "data-alarm": name, "data-state": state, title: [about, since, reason].filter(Boolean).join("\n") },
    ...(state === "ALARM"
      ? [el("a", { href: route({ view: "alarms" }) }, name, " ", el("b", {}, STATES[state]))]
      : state === "OK"
        ? [name]
        : [name, " ", el("b", {}, STATES[state])]),
  );
}

function chart(
  host: HTMLElement,
  { title, series, period_s }: Widget,
  range: readonly [number, number],
): RangeChart {
  const times = [...new Set(series.flatMap(({ times_s }) => times_s))].sort((a, b) => a - b);
  const curves: Curve[] = series.map(({ label, right }, i) => {
    const dash = DASHES[Math.floor(i / COLOURS.length) % DASHES.length];
    return { label, right, colour: COLOURS[i % COLOURS.length]!, points: true, ...(dash ? { dash } : {}) };
  });
  const about = { title, write: (value: number) => number(value, digits(value)) };
  return new RangeChart(
    host,
    { about, curves, zero: true, sync: "cloudwatch", hole_s: period_s * 1.5 },
    [times, ...series.map((each) => aligned(each, times))],
    range,
  );
}

function aligned({ times_s, values }: Series, times: readonly number[]): (number | null)[] {
  const known = new Map(times_s.map((at, i) => [at, values[i]!]));
  return times.map((at) => known.get(at) ?? null);
}

/** Headings and paragraphs; a dashboard's text is never read as HTML. */
function markdown(text: string): HTMLElement[] {
  return text
    .split("\n")
    .filter((line) => line.trim() !== "")
    .map((line) => {
      const heading = /^#+\s+(.*)$/.exec(line);
      return heading ? el("h3", {}, heading[1]!) : el("p", {}, line);
    });
}

function digits(value: number): number {
  return Number.isInteger(value) ? 0 : Math.abs(value) < 10 ? 2 : 1;
}
