// A scrolling chart of the last seconds or minutes by uPlot, drawn only when it would change.

import uPlot from "uplot";
import { AS_SENT, age, type Linear, linear } from "../base/format";
import { colour, onTheme } from "../base/theme";
import type { Ring } from "../live/ring";
import { axis, calm, faint, fit, holes, labels, PLAIN, paint, rem, roundRange } from "./axes";
import { type About, Spoken } from "./spoken";
import { markLabels, marks, WINDOWS } from "./windows";

export interface Line {
  /** The custom property of its colour. */
  readonly colour: string;
  readonly dash?: readonly number[];
  /** A faint area between the line and zero. */
  readonly fill?: boolean;
}

export interface LiveChartOptions {
  readonly lines: readonly Line[];
  /** The minimum height of the axis, so that noise stays small. */
  readonly span: number;
  /** The axis always holds zero. */
  readonly zero?: boolean;
  /** Its title, its lines' names, and a value with its unit. */
  readonly about: Pick<About, "title" | "lines" | "write">;
  /** Called with the values under the pointer and their age in seconds; undefined when it leaves. */
  readonly onPoint?: (
    point: { readonly ago: number; readonly values: readonly number[] } | undefined,
  ) => void;
}

/** A history, and a column for each line; undefined if it does not exist yet. */
export interface Shown {
  readonly history: Ring;
  readonly columns: readonly (number | undefined)[];
}

// A line has a gap after this time without a value.
const HOLE_S = 1;
// A chart is not drawn for a smaller step, nor more than 25 times a second.
const STEP_PX = 0.75;
const FRAME_S = 0.04;
// Longer windows are drawn too seldom to ease their axis.
const EASED_S = 60;

const shared = uPlot.sync("charts");

export class LiveChart {
  private readonly plot: uPlot;
  private readonly spoken: Spoken;
  private readonly offTheme: () => void;
  private shown: Shown | undefined;
  private as: Linear = AS_SENT;
  private filled: number | undefined;
  private window_s: number = WINDOWS[0];
  private dirty = true;
  private drawnAt = -Infinity;
  private drawnEmpty = false;
  private visible = true;
  private right = 0;
  private low = 0;
  private high = 1;
  private palette: string[] = [];
  private paint = paint();

  constructor(
    host: HTMLElement,
    private readonly options: LiveChartOptions,
  ) {
    this.readColours();
    const colours = () => this.paint;
    this.plot = new uPlot(
      {
        ...PLAIN,
        width: Math.max(1, host.clientWidth),
        height: Math.max(1, host.clientHeight),
        pxAlign: 0,
        padding: [rem(0.5), rem(0.9), 0, 0],
        cursor: {
          y: false,
          drag: { x: false, y: false, setScale: false },
          points: { size: 7, width: 0 },
          sync: { key: shared.key, setSeries: false },
        },
        scales: {
          x: { time: false, auto: false },
          y: { auto: true, range: (_, low, high) => this.range(low, high) },
        },
        axes: [
          axis(colours, 1.5, 0.3, {
            splits: (_, __, low) => marks(this.window_s).map((mark) => low + mark),
            values: () => markLabels(this.window_s),
          }),
          axis(colours, 3.1, 0.4, { space: rem(2.2), values: (_, splits) => labels(splits) }),
        ],
        series: [
          {},
          ...options.lines.map((line, i) => ({
            stroke: () => this.palette[i]!,
            width: 1.75,
            pxAlign: 0,
            points: { show: false },
            gaps: holes(() => HOLE_S),
            ...(line.dash ? { dash: [...line.dash] } : {}),
            ...(line.fill ? { fill: () => faint(this.palette[i]!), fillTo: 0 } : {}),
          })),
        ],
        hooks: {
          draw: [(plot) => this.drawHeads(plot)],
          setCursor: [(plot) => this.point(plot)],
        },
      },
      this.data(0),
      host,
    );
    this.spoken = new Spoken(host, this.plot, {
      ...options.about,
      range: () => `last ${age(this.window_s)}`,
      at: (seconds) => `${age(this.right - seconds)} ago`,
    });
    fit(host, this.plot, (visible) => {
      this.visible = visible;
      this.dirty = true;
    });
    this.offTheme = onTheme(() => {
      this.readColours();
      this.dirty = true;
    });
  }

  /** Set the data, undefined for none, and its scale. */
  show(shown: Shown | undefined, as: Linear): void {
    const same =
      this.shown?.history === shown?.history &&
      String(this.shown?.columns) === String(shown?.columns) &&
      this.filled === shown?.history.inserted;
    if (same && this.as.scale === as.scale && this.as.shift === as.shift) return;
    [this.shown, this.as, this.filled] = [shown, as, shown?.history.inserted];
    this.dirty = true;
    this.drawnEmpty = false;
    this.low = this.high = NaN;
  }

  /** Show the last `window_s` seconds. */
  span(window_s: number): void {
    if (window_s === this.window_s) return;
    [this.window_s, this.dirty, this.drawnEmpty] = [window_s, true, false];
  }

  destroy(): void {
    this.offTheme();
    this.plot.destroy();
  }

  /** Whether the chart must be drawn: it would visibly change, or its data or size has changed. */
  due(now: number): boolean {
    if (!this.visible || now - this.drawnAt < FRAME_S) return false;
    if (this.dirty) return true;
    return !this.drawnEmpty && ((edge(now) - this.right) / this.window_s) * this.plot.bbox.width >= STEP_PX;
  }

  draw(now: number): void {
    if (!this.visible) return;
    const right = edge(now);
    const data = this.data(right - this.window_s);
    [this.right, this.drawnAt, this.dirty] = [right, now, false];
    this.drawnEmpty = this.shown === undefined || !(this.shown.history.last(0) > right - this.window_s);
    this.plot.batch(() => {
      this.plot.setData(data, false);
      this.plot.setScale("x", { min: right - this.window_s, max: right });
    });
    this.spoken.refresh();
  }

  /** Draw again after a time without data. */
  wake(): void {
    if (this.drawnEmpty) this.dirty = true;
  }

  private data(from: number): uPlot.AlignedData {
    const { shown, as } = this;
    if (!shown) return [new Float64Array(0), ...this.options.lines.map(() => new Float64Array(0))];
    const times = shown.history.column(0, from);
    const columns = shown.columns.map((column) => {
      if (column === undefined) return new Float64Array(times.length).fill(NaN);
      const values = shown.history.column(column, from);
      return as.scale === 1 && as.shift === 0 ? values : values.map((value) => linear(value, as));
    });
    return [times, ...columns];
  }

  /** The axis' range: round numbers around the data, approached in a few frames. */
  private range(low: number | null, high: number | null): [number, number] {
    const [least, most] = low === null || high === null || !(low <= high) ? [0, 0] : [low, high];
    const [toLow, toHigh] = roundRange(least, most, this.options.span, this.options.zero ?? false);
    const ease = (from: number, to: number): number =>
      calm() ||
      this.window_s > EASED_S ||
      Number.isNaN(from) ||
      Math.abs(to - from) < (toHigh - toLow) * 0.004
        ? to
        : from + (to - from) * 0.3;
    this.low = ease(this.low, toLow);
    this.high = ease(this.high, toHigh);
    return [this.low, this.high];
  }

  /** Draw a dot at the newest value of every line. */
  private drawHeads(plot: uPlot): void {
    const times = plot.data[0];
    const at = times[times.length - 1];
    if (at === undefined || at < this.right - this.window_s) return;
    const { ctx } = plot;
    const radius = 2.6 * uPlot.pxRatio;
    plot.series.slice(1).forEach((_, i) => {
      const value = plot.data[i + 1]?.[times.length - 1];
      if (value === undefined || value === null || Number.isNaN(value)) return;
      ctx.beginPath();
      ctx.arc(plot.valToPos(at, "x", true), plot.valToPos(value, "y", true), radius, 0, 2 * Math.PI);
      ctx.fillStyle = this.palette[i]!;
      ctx.fill();
    });
  }

  private point(plot: uPlot): void {
    const { idx, left } = plot.cursor;
    if (!this.options.onPoint) return;
    if (idx === null || idx === undefined || left === undefined || left < 0) this.options.onPoint(undefined);
    else {
      const ago = this.right - (plot.data[0][idx] ?? NaN);
      this.options.onPoint({ ago, values: plot.data.slice(1).map((values) => values[idx] ?? NaN) });
    }
  }

  private readColours(): void {
    this.palette = this.options.lines.map((line) => colour(line.colour));
    this.paint = paint();
  }
}

/** The right edge: now, or the next full second for viewers who prefer less motion. */
function edge(now: number): number {
  return calm() ? Math.ceil(now) : now;
}
