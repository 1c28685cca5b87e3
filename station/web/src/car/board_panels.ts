// What a car's board is made of: each panel finds its values in the car, and is hidden while the car has none.

import type { FieldTable, TrackMap } from "../base/contract";
import { el, panel } from "../base/dom";
import { AS_SENT, type Linear, linear, spec } from "../base/format";
import { ChartPanel } from "../charts/chart_panel";
import { edges } from "../charts/track_map";
import { WINDOWS, windowLabel } from "../charts/windows";
import { type Track, XYChart } from "../charts/xy_chart";
import type { Robot } from "../live/robot";
import { numeric, type Stream } from "../live/stream";
import { BOARD, type LineSpec, type XYChartSpec } from "./car_charts";

const MOST_POINTS = 4000;

export interface BoardPanel {
  readonly title: string;
  readonly node: HTMLElement;
  /** Take the newest values; whether the car has any. */
  values(robot: Robot, speed: Linear | undefined): boolean;
  due(now: number): boolean;
  draw(now: number): void;
  /** Show the last `window_s` seconds. */
  span(window_s: number): void;
  destroy(): void;
}

/** A field's key: two streams may have fields of the same name. */
export const fieldKey = (stream: string, field: string): string => `${stream}/${field}`;

/** The panel of a chart's or a field's key; undefined for a text that is neither. */
export function panelOf(key: string, table: FieldTable, track: TrackMap | null): BoardPanel | undefined {
  const known = BOARD.get(key);
  if (known?.kind === "line") return new LinePanel(known, table);
  if (known?.kind === "delay") return new DelayPanel(known);
  if (known) return new XYPanel(known, track);
  const [stream, field, ...rest] = key.split("/");
  return stream && field && rest.length === 0 ? new FieldPanel(stream, field, table) : undefined;
}

class LinePanel extends ChartPanel implements BoardPanel {
  constructor(
    private readonly spec: LineSpec,
    private readonly table: FieldTable,
  ) {
    super(spec);
  }

  values(robot: Robot, speed: Linear | undefined): boolean {
    const { fields, as } = this.spec;
    const vesc = robot.vesc(this.table);
    const columns = fields.map((field) => vesc?.columns.get(field));
    this.show(vesc && { history: vesc.history, columns }, ...as(speed));
    this.update(fields.map((field) => numeric(vesc?.sample.get(field))));
    return vesc !== undefined;
  }
}

class DelayPanel extends ChartPanel implements BoardPanel {
  values(robot: Robot): boolean {
    this.show({ history: robot.delays, columns: [1] }, AS_SENT);
    this.update([robot.newestDelay()?.total ?? NaN]);
    return true;
  }
}

class FieldPanel extends ChartPanel implements BoardPanel {
  constructor(
    private readonly stream: string,
    private readonly field: string,
    private readonly table: FieldTable,
  ) {
    const { label, unit, digits } = spec(field, table, false, stream);
    const reading = {
      name: fieldKey(stream, field),
      unit,
      from: ([value = NaN]: readonly number[]) => value,
      ...(digits === undefined ? {} : { digits }),
    };
    super({ title: label, readings: [reading], chart: { lines: [{ colour: "--accent" }], span: 1e-3 } });
  }

  values(robot: Robot): boolean {
    const stream = robot.streams.get(this.stream);
    const as = spec(this.field, this.table, stream?.ros2, this.stream);
    const shown = stream && { history: stream.history, columns: [stream.columns.get(this.field)] };
    this.show(shown, as, as.unit);
    this.update([numeric(stream?.sample.get(this.field))]);
    return stream?.columns.has(this.field) ?? false;
  }
}

/** Two fields of a stream, and the scale of the first. */
interface Source {
  readonly stream: Stream;
  readonly x: string;
  readonly y: string;
  readonly as: Linear;
}

class XYPanel implements BoardPanel {
  readonly title: string;
  readonly node: HTMLElement;
  private readonly chart: XYChart;
  private readonly note = el("p", { class: "note" });
  private source: Source | undefined;
  private unit = "";
  private window_s = 0;

  constructor(
    private readonly spec: XYChartSpec,
    track: TrackMap | null,
  ) {
    const host = el("div", { class: "plot" });
    this.title = spec.title;
    this.node = panel(spec.title, "xy", [this.note], host);
    this.chart = new XYChart(host, {
      ...spec,
      x: () => spec.x + this.unit,
      ...(spec.map && track ? { ground: edges(track) } : {}),
    });
    this.span(WINDOWS[0]);
  }

  values(robot: Robot, speed: Linear | undefined): boolean {
    this.source = undefined;
    if (this.spec.speed) this.unit = speed ? ", m/s" : ", erpm";
    for (const stream of robot.streams.values()) {
      const axes = this.spec.axes(stream.columns);
      if (!axes) continue;
      this.source = { stream, x: axes[0], y: axes[1], as: (this.spec.speed && speed) || AS_SENT };
      return true;
    }
    return false;
  }

  due(now: number): boolean {
    return this.source !== undefined && this.chart.due(now);
  }

  draw(now: number): void {
    const { source } = this;
    if (source) this.chart.draw(now, () => track(source, now - this.window_s));
  }

  span(window_s: number): void {
    this.window_s = window_s;
    this.note.textContent = `last ${windowLabel(window_s)}`;
  }

  destroy(): void {
    this.chart.destroy();
  }
}

function track({ stream, x, y, as }: Source, from: number): Track {
  const column = (field: string): Float64Array => stream.history.column(stream.columns.get(field)!, from);
  const [across, up] = [column(x), column(y)];
  // A long window has more points than the chart has pixels.
  const step = Math.ceil(across.length / MOST_POINTS);
  const thin = (values: Float64Array): Float64Array =>
    step > 1 ? values.filter((_, i) => (values.length - 1 - i) % step === 0) : values;
  return { x: as === AS_SENT ? thin(across) : thin(across).map((value) => linear(value, as)), y: thin(up) };
}
