// CloudWatch's deployed dashboards, drawn from the cloud's metrics.

import type { Alarm, Config, Dashboard, Series, Widget } from "../base/contract";
import { el, Text } from "../base/dom";
import { NOTHING, number, when } from "../base/format";
import { route } from "../base/route";
import { type Curve, RangeChart } from "../charts/range_chart";
import { AnswerError, ask } from "../server/answers";
import { LogTable } from "../widgets/log_table";
import type { Services, View } from "./view";

const REFRESH_S = 30;
const RANGES = [
  ["15 min", 15],
  ["1 h", 60],
  ["3 h", 180],
  ["24 h", 1440],
] as const;
const COLOURS = ["--hue-1", "--hue-2", "--hue-3", "--hue-4", "--hue-5", "--hue-6"];
const DASHES = [undefined, [6, 3], [2, 3]] as const;

export class CloudWatchView implements View {
  readonly node: HTMLElement;
  private readonly config: Config;
  private readonly choice = el("select", { id: "dashboard", name: "dashboard" });
  private readonly range = el("select", { id: "minutes", name: "minutes" });
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly grid = el("div", { class: "widgets" });
  private charts: RangeChart[] = [];
  private logs = new Map<string, LogTable>();
  private timer: number | undefined;
  private loading: AbortController | undefined;

  constructor({ config }: Services) {
    this.config = config;
    this.range.append(...RANGES.map(([label, minutes]) => el("option", { value: String(minutes) }, label)));
    this.range.value = "60";
    for (const each of [this.choice, this.range]) each.addEventListener("change", () => void this.load());
    const form = el(
      "p",
      { class: "range" },
      el("label", {}, "dashboard ", this.choice),
      el("label", {}, "last ", this.range),
    );
    const told = el(
      "p",
      { class: "unserved" },
      "This page was put on the web as it is, and cannot read CloudWatch. Run ",
      el("code", {}, "iort dashboard"),
      ", or look at them in the AWS console.",
    );
    this.node = el(
      "article",
      { class: "cloudwatch" },
      el("header", { class: "car-head" }, el("h2", { class: "car-name" }, "CloudWatch"), this.note.node),
      ...(config.answers ? [form, this.grid] : [told]),
    );
  }

  title(): string {
    return "CloudWatch · iort";
  }

  show(): void {
    this.rest();
    if (!this.config.answers) return;
    void this.find();
    this.timer = window.setInterval(() => !document.hidden && void this.load(), REFRESH_S * 1000);
  }

  leave(): void {
    this.rest();
    for (const log of this.logs.values()) log.stop();
  }

  private rest(): void {
    window.clearInterval(this.timer);
    this.loading?.abort();
  }

  private async find(): Promise<void> {
    this.note.set("Loading …");
    try {
      const { dashboards } = await ask<{ dashboards: string[] }>("dashboards", {});
      const before = this.choice.value;
      this.choice.replaceChildren(...dashboards.map((name) => el("option", { value: name }, name)));
      if (dashboards.includes(before)) this.choice.value = before;
      if (dashboards.length === 0) this.note.set("No dashboard is deployed.");
      else await this.load();
    } catch (error) {
      this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }

  private async load(): Promise<void> {
    if (!this.choice.value) return;
    this.loading?.abort();
    const loading = new AbortController();
    this.loading = loading;
    try {
      const dashboard = await ask<Dashboard>(
        "dashboard",
        { name: this.choice.value, minutes: this.range.value },
        loading.signal,
      );
      if (loading.signal.aborted) return;
      this.draw(dashboard);
      // The dashboard ends with the current minute.
      const at = Date.now() / 1000;
      this.note.set(`as of ${when(at)}, again every ${REFRESH_S} s`);
    } catch (error) {
      if (!loading.signal.aborted)
        this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }

  private draw({ name, widgets, from_s, to_s }: Dashboard): void {
    for (const chart of this.charts) chart.destroy();
    this.charts = [];
    const logs = new Map<string, LogTable>();
    const ordered = [...widgets].sort((a, b) => a.y - b.y || a.x - b.x);
    this.grid.replaceChildren(
      ...ordered
        .map((widget) => {
          const [node, plot] = frame(widget);
          node.style.setProperty("--across", String(widget.width));
          node.style.setProperty("--down", String(widget.height));
          return [node, plot, widget] as const;
        })
        .map(([node, plot, widget]) => {
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
  const heading = el("header", {}, el("h3", { title: widget.title }, widget.title));
  const node = el(
    "section",
    { class: "panel widget", "aria-label": widget.title, "data-widget": widget.title },
    heading,
  );
  if (widget.kind === "log") return [node, undefined];
  if (widget.kind === "other") {
    node.append(el("p", { class: "note" }, widget.text));
    return [node, undefined];
  }
  if (widget.kind === "alarms") {
    const raised = widget.alarms.filter(({ state }) => state === "ALARM").length;
    heading.append(
      el(
        "span",
        { class: "note" },
        raised === 0
          ? `none of ${widget.alarms.length} raised`
          : `${raised} of ${widget.alarms.length} raised`,
      ),
    );
    node.append(el("ul", { class: "alarms" }, ...[...widget.alarms].sort(byUrgency).map(alarm)));
    return [node, undefined];
  }
  const any = widget.series.some((series) => series.values.length > 0);
  const legend = el(
    "ul",
    { class: "legend" },
    ...widget.series.map((series, i) =>
      el(
        "li",
        { "data-series": series.label },
        el("span", { class: `key ${COLOURS[i % COLOURS.length]!.slice(2)}` }),
        series.label,
        " ",
        el(
          "b",
          { class: "num" },
          series.values.length > 0 ? number(series.values.at(-1)!, digits(series.values.at(-1)!)) : NOTHING,
        ),
      ),
    ),
  );
  if (widget.kind === "number") {
    node.append(legend);
    return [node, undefined];
  }
  const plot = el("div", { class: "plot", ...(any ? {} : { "data-empty": "no data in this range" }) });
  node.append(plot, legend);
  return [node, plot];
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
