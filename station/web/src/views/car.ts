// One car in full: gauges, charts, the delay by hop, XY charts, faults, and every field of every stream.

import type { FieldTable } from "../base/contract";
import type { Shown } from "../charts/live_chart";
import { byName, el, setAttribute, Text } from "../base/dom";
import { FaultLog } from "../widgets/fault_log";
import type { Fleet } from "../live/fleet";
import { MEDIAN_S, WINDOW_S } from "../live/bounds";
import { median, type Robot } from "../live/robot";
import { numeric, type Stream } from "../live/stream";
import { age, AS_SENT, linear, spec, type Linear } from "../base/format";
import { Gauge } from "../charts/gauge";
import { ChartPanel } from "../charts/chart_panel";
import { XYChart, type Track } from "../charts/xy_chart";
import { Ring } from "../live/ring";
import { fieldKey, StreamSection } from "../widgets/field_tiles";
import { Waterfall } from "../charts/waterfall";
import { DELAY_CHART, GAUGES, XY_CHARTS, LINE_CHARTS, type XYChartSpec } from "../charts/car_charts";

const MOST_CHOSEN = 6;
// Values are updated at most 25 times a second.
const SCREENS = 25 * MEDIAN_S;

interface ShownXYChart {
  readonly spec: XYChartSpec;
  readonly node: HTMLElement;
  readonly chart: XYChart;
  source: { readonly stream: Stream; readonly x: string; readonly y: string; readonly as: Linear } | undefined;
  unit: string;
}

export class CarView {
  readonly node: HTMLElement;
  private readonly title = new Text("car-name", "h2");
  private readonly state = new Text("car-state");
  private readonly fault = el("p", { class: "fault", role: "alert", hidden: "" });
  private readonly gauges: readonly Gauge[];
  private readonly gaugeRow = el("div", { class: "gauges" });
  private readonly charts = el("div", { class: "charts" });
  private readonly chosenCharts = el("div", { class: "charts" });
  private readonly streams = el("div", { class: "streams" });
  private readonly panels: readonly ChartPanel[];
  private readonly delay: ChartPanel;
  private readonly xyCharts: readonly ShownXYChart[];
  private readonly waterfall = new Waterfall();
  private readonly faults = new FaultLog();
  private readonly sections = new Map<Stream, StreamSection>();
  private readonly chosen = new Map<string, { readonly panel: ChartPanel; readonly stream: Stream; readonly field: string; ros2: boolean }>();
  private robot: Robot | undefined;
  private drawn = -1;
  /** The time at which a message was drawn, and its delay since arrival in milliseconds. */
  private screens = new Ring(2, SCREENS, MEDIAN_S);

  constructor(
    private readonly fleet: Fleet,
    private readonly table: FieldTable,
    tools: HTMLElement,
  ) {
    this.gauges = GAUGES.map((each) => new Gauge(each));
    this.gaugeRow.append(...this.gauges.map(({ node }) => node));
    const aside = el("aside", { class: "aside" });
    this.panels = LINE_CHARTS.map((options) => new ChartPanel(this.charts, options));
    aside.append(this.waterfall.node);
    this.delay = new ChartPanel(aside, DELAY_CHART);
    const xyRow = el("div", { class: "xy-charts" });
    this.xyCharts = XY_CHARTS.map((spec) => {
      const host = el("div", { class: "plot", "aria-hidden": "true" });
      const node = el("section", { class: "panel", "aria-label": spec.title }, el("header", {}, el("h3", {}, spec.title), el("p", { class: "note" }, `last ${WINDOW_S} s`)), host);
      xyRow.append(node);
      const shown: ShownXYChart = { spec, node, chart: new XYChart(host, { ...spec, x: () => spec.x + shown.unit }), source: undefined, unit: "" };
      return shown;
    });
    xyRow.append(this.faults.node);
    this.node = el(
      "article",
      { class: "car", id: "car" },
      el("header", { class: "car-head" }, this.title.node, this.state.node, this.fault, tools),
      this.gaugeRow,
      el("div", { class: "board" }, this.charts, aside),
      xyRow,
      this.chosenCharts,
      this.streams,
    );
  }

  show(robot: Robot | undefined): void {
    if (this.robot !== robot) {
      this.robot = robot;
      this.sections.clear();
      this.streams.replaceChildren();
      for (const key of [...this.chosen.keys()]) this.close(key);
      for (const gauge of this.gauges) gauge.reset();
      this.drawn = -1;
      this.screens = new Ring(2, SCREENS, MEDIAN_S);
      this.title.set(robot?.name ?? "");
    }
    this.arrange();
  }

  /** Make a section for each stream; called when a stream is new. */
  private arrange(): void {
    const { robot, table } = this;
    if (!robot) return;
    const vesc = robot.vesc(table);
    const gauged = new Set(vesc ? GAUGES.flatMap(({ fields }) => fields) : []);
    for (const each of [this.charts, this.gaugeRow]) each.hidden = vesc === undefined;
    setAttribute(this.node, "data-vesc", String(vesc !== undefined));
    this.delay.show({ history: robot.delays, columns: [1] }, AS_SENT);
    const ordered = [...robot.streams.values()].sort((a, b) => Number(b === vesc) - Number(a === vesc) || byName(a.name, b.name));
    for (const stream of ordered) {
      let section = this.sections.get(stream);
      if (!section) {
        const except: ReadonlySet<string> = stream === vesc ? gauged : new Set();
        section = new StreamSection(stream, table, except, (field) => this.choose(stream, field));
        this.sections.set(stream, section);
      }
      this.streams.append(section.node);
    }
  }

  /** Chart a field, or remove its chart. */
  private choose(stream: Stream, field: string): void {
    const key = fieldKey(stream.name, field);
    if (this.chosen.has(key)) {
      this.close(key);
      return;
    }
    if (this.chosen.size >= MOST_CHOSEN) this.close(this.chosen.keys().next().value!);
    const { label, unit, digits, ...as } = spec(field, this.table, stream.ros2);
    const reading = { name: key, unit, from: ([value = NaN]: readonly number[]) => value, ...(digits === undefined ? {} : { digits }) };
    const panel = new ChartPanel(this.chosenCharts, {
      title: label,
      readings: [reading],
      chart: { lines: [{ colour: "--accent" }], span: 1e-3 },
      onClose: () => this.close(key),
    });
    panel.show({ history: stream.history, columns: [stream.columns.get(field)] }, as);
    this.chosen.set(key, { panel, stream, field, ros2: stream.ros2 });
    panel.node.scrollIntoView({ block: "nearest" });
  }

  private close(key: string): void {
    this.chosen.get(key)?.panel.node.remove();
    this.chosen.delete(key);
  }

  /** Update what changes with a message. */
  values(now: number): void {
    const { robot, table } = this;
    if (!robot || robot.version === this.drawn) return;
    this.drawn = robot.version;
    this.screens.push([now, (now - robot.heardAt) * 1000]);
    const vesc = robot.vesc(table);
    const speed = this.fleet.speed(robot.name);
    const newest = (field: string): number => numeric(vesc?.sample.get(field));
    GAUGES.forEach((each, i) => {
      const show = each.show(newest, robot, speed);
      const [least, most] = vesc && each.extent ? span(vesc, each.extent, now, show.as ?? AS_SENT) : [NaN, NaN];
      this.gauges[i]!.set(show.value, least, most, show.unit, show.digits);
    });
    this.panels.forEach((panel, i) => {
      const { fields, as } = LINE_CHARTS[i]!;
      panel.show(shown(vesc, fields), ...as(speed));
      panel.update(fields.map(newest));
    });
    this.delay.update([robot.newestDelay()?.total ?? NaN]);
    for (const each of this.chosen.values()) {
      const { panel, stream, field } = each;
      if (each.ros2 !== stream.ros2) {
        const as = spec(field, table, stream.ros2);
        panel.show({ history: stream.history, columns: [stream.columns.get(field)] }, as, as.unit);
        each.ros2 = stream.ros2;
      }
      panel.update([numeric(stream.sample.get(field))]);
    }
    for (const section of this.sections.values()) section.values();
    this.findPlanes(robot, speed);
    const fault = robot.fault(table);
    const text = fault ? `Fault: ${fault}` : "";
    if (this.fault.textContent !== text) this.fault.textContent = text;
    this.fault.hidden = !fault;
  }

  private findPlanes(robot: Robot, speed: Linear | undefined): void {
    for (const each of this.xyCharts) {
      each.source = undefined;
      if (each.spec.speed) each.unit = speed ? ", m/s" : ", erpm";
      for (const stream of robot.streams.values()) {
        const axes = each.spec.axes(stream.columns);
        if (axes) {
          each.source = { stream, x: axes[0], y: axes[1], as: (each.spec.speed && speed) || AS_SENT };
          break;
        }
      }
      each.node.hidden = each.source === undefined;
    }
  }

  /** Update what changes with time. */
  clock(now: number, linked: boolean): void {
    const { robot } = this;
    if (!robot) return;
    const charted = new Set(this.chosen.keys());
    for (const section of this.sections.values()) section.clock(now, charted);
    const screens = this.screens.column(1, now - MEDIAN_S);
    this.waterfall.refresh(robot, now, screens.length > 0 ? median(screens) : NaN);
    this.faults.refresh(robot);
    const fresh = robot.freshness(now);
    setAttribute(this.node, "data-state", linked || fresh === "live" ? fresh : "unlinked");
    const texts = {
      live: "live",
      stale: `stale: newest values are ${age(now - robot.takenAt)} old`,
      gone: `gone: last heard ${age(now - robot.heardAt)} ago`,
    };
    this.state.set(linked || fresh === "live" ? texts[fresh] : `no connection: values are ${age(now - robot.heardAt)} old`);
  }

  draw(now: number): void {
    if (!this.robot) return;
    const panels = [...(this.charts.hidden ? [] : this.panels), this.delay, ...[...this.chosen.values()].map(({ panel }) => panel)];
    // All in the same frame: a frame costs more than its charts.
    if (!panels.some((panel) => panel.due(now))) return;
    for (const panel of panels) panel.draw(now);
    for (const { chart, source } of this.xyCharts) if (source) chart.draw(now, () => track(source, now));
  }
}

function shown(stream: Stream | undefined, fields: readonly string[]): Shown | undefined {
  return stream && { history: stream.history, columns: fields.map((field) => stream.columns.get(field)) };
}

function track({ stream, x, y, as }: NonNullable<ShownXYChart["source"]>, now: number): Track {
  const column = (field: string): Float64Array => stream.history.column(stream.columns.get(field) ?? 0, now - WINDOW_S);
  const across = column(x);
  return { x: as === AS_SENT ? across : across.map((value) => linear(value, as)), y: column(y) };
}

/** The minimum and maximum of a field in the last 30 s. */
function span(stream: Stream, field: string, now: number, as: Linear): [number, number] {
  const column = stream.columns.get(field);
  if (column === undefined) return [NaN, NaN];
  let [low, high] = [Infinity, -Infinity];
  for (const value of stream.history.column(column, now - WINDOW_S)) {
    const shown = linear(value, as);
    if (shown < low) low = shown;
    if (shown > high) high = shown;
  }
  return [low, high];
}
