// A chart of the last 30 seconds that scrolls: uPlot, drawn only when there is something new to see.

import uPlot from "uplot";
import { WINDOW_S } from "./fleet";
import type { Ring } from "./ring";
import { colour, onTheme } from "./theme";

export interface Line {
  /** The column of the history. */
  readonly column: number;
  /** The custom property that holds its colour. */
  readonly colour: string;
  readonly dash?: readonly number[];
  /** A faint area between the line and zero. */
  readonly fill?: boolean;
}

export interface ChartOptions {
  readonly lines: readonly Line[];
  /** The least height of the axis, so that noise is not drawn as a mountain. */
  readonly span: number;
  /** The axis always holds zero. */
  readonly zero?: boolean;
  /** Told what is under the pointer: seconds ago and a value a line, unscaled; undefined when it leaves. */
  readonly onPoint?: (point: { readonly ago: number; readonly values: readonly number[] } | undefined) => void;
}

// A line is broken where nothing came for so long.
const HOLE_S = 1;
// Moving by less than this share of a pixel cannot be seen, nor can more than 60 pictures a second.
const STEP_PX = 0.5;
const FRAME_S = 0.014;

const calm = window.matchMedia("(prefers-reduced-motion: reduce)");
const shared = uPlot.sync("charts");

export class Chart {
  private readonly plot: uPlot;
  private history: Ring | undefined;
  private scale = 1;
  private dirty = true;
  private drawnAt = -Infinity;
  private drawnEmpty = false;
  private visible = true;
  private right = 0;
  private low = 0;
  private high = 1;
  private palette: string[] = [];
  private paint = { text: "", grid: "" };

  constructor(
    host: HTMLElement,
    private readonly options: ChartOptions,
  ) {
    this.readColours();
    const font = `${Math.round(rem(0.72))}px ${getComputedStyle(document.body).fontFamily}`;
    this.plot = new uPlot(
      {
        width: Math.max(1, host.clientWidth),
        height: Math.max(1, host.clientHeight),
        pxAlign: 0,
        padding: [rem(0.5), rem(0.9), 0, 0],
        legend: { show: false },
        select: { show: false, left: 0, top: 0, width: 0, height: 0 },
        cursor: {
          y: false,
          drag: { x: false, y: false, setScale: false },
          points: { size: 7, width: 0 },
          sync: { key: shared.key, setSeries: false },
        },
        scales: { x: { time: false, auto: false }, y: { auto: true, range: (_, low, high) => this.range(low, high) } },
        axes: [
          {
            font,
            size: rem(1.5),
            gap: rem(0.3),
            stroke: () => this.paint.text,
            grid: { stroke: () => this.paint.grid, width: 1 },
            ticks: { show: false },
            splits: (_, __, low) => [0, 10, 20, 30].map((step) => low + step),
            values: () => ["\u221230 s", "\u221220", "\u221210", "now"],
          },
          {
            font,
            size: rem(3.1),
            gap: rem(0.4),
            stroke: () => this.paint.text,
            grid: { stroke: () => this.paint.grid, width: 1 },
            ticks: { show: false },
            space: rem(2.2),
            values: (_, splits) => labels(splits),
          },
        ],
        series: [
          {},
          ...options.lines.map((line, i) => ({
            stroke: () => this.palette[i]!,
            width: 1.75,
            pxAlign: 0,
            points: { show: false },
            gaps: holes,
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
    new ResizeObserver(() => {
      if (host.clientWidth > 0) this.plot.setSize({ width: host.clientWidth, height: host.clientHeight });
      this.dirty = true;
    }).observe(host);
    new IntersectionObserver((entries) => {
      this.visible = entries.at(-1)?.isIntersecting ?? true;
      this.dirty = true;
    }).observe(host);
    onTheme(() => {
      this.readColours();
      this.dirty = true;
    });
  }

  /** What to show from now on, undefined for nothing, and what to multiply it by. */
  show(history: Ring | undefined, scale: number): void {
    if (this.history === history && this.scale === scale) return;
    [this.history, this.scale] = [history, scale];
    this.dirty = true;
    this.drawnEmpty = false;
    this.low = this.high = NaN;
  }

  /** Whether the picture would differ by half a pixel, or must be drawn for another reason. */
  due(now: number): boolean {
    if (!this.visible || now - this.drawnAt < FRAME_S) return false;
    if (this.dirty) return true;
    return !this.drawnEmpty && ((edge(now) - this.right) / WINDOW_S) * this.plot.bbox.width >= STEP_PX;
  }

  draw(now: number): void {
    if (!this.visible) return;
    const right = edge(now);
    const data = this.data(right - WINDOW_S);
    [this.right, this.drawnAt, this.dirty] = [right, now, false];
    this.drawnEmpty = this.history === undefined || !(this.history.last(0) > right - WINDOW_S);
    this.plot.batch(() => {
      this.plot.setData(data, false);
      this.plot.setScale("x", { min: right - WINDOW_S, max: right });
    });
  }

  /** There is something to draw again, after a time in which there was not. */
  wake(): void {
    if (this.drawnEmpty) this.dirty = true;
  }

  private data(from: number): uPlot.AlignedData {
    const { history, scale } = this;
    const { lines } = this.options;
    if (!history) return [new Float64Array(0), ...lines.map(() => new Float64Array(0))];
    const columns = lines.map(({ column }) => {
      const values = history.column(column, from);
      return scale === 1 ? values : values.map((value) => value * scale);
    });
    return [history.column(0, from), ...columns];
  }

  /** The axis: round numbers that hold the data, reached in a few frames rather than at once. */
  private range(low: number | null, high: number | null): [number, number] {
    let [least, most] = low === null || high === null || !(low <= high) ? [0, 0] : [low, high];
    if (this.options.zero) [least, most] = [Math.min(0, least), Math.max(0, most)];
    const missing = this.options.span - (most - least);
    if (missing > 0 && this.options.zero && least === 0) most += missing;
    else if (missing > 0) [least, most] = [least - missing / 2, most + missing / 2];
    const step = roundStep((most - least) / 8);
    const [toLow, toHigh] = [Math.floor(least / step + 1e-9) * step, Math.ceil(most / step - 1e-9) * step];
    const ease = (from: number, to: number): number =>
      calm.matches || Number.isNaN(from) || Math.abs(to - from) < (toHigh - toLow) * 0.004 ? to : from + (to - from) * 0.22;
    this.low = ease(this.low, toLow);
    this.high = ease(this.high, toHigh);
    return [this.low, this.high];
  }

  /** A dot at the newest value of every line, where the eye waits for news. */
  private drawHeads(plot: uPlot): void {
    const times = plot.data[0];
    const at = times[times.length - 1];
    if (at === undefined || at < this.right - WINDOW_S) return;
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
      this.options.onPoint({ ago, values: plot.data.slice(1).map((values) => (values[idx] ?? NaN) / this.scale) });
    }
  }

  private readColours(): void {
    this.palette = this.options.lines.map((line) => colour(line.colour));
    this.paint = { text: colour("--muted"), grid: colour("--grid") };
  }
}

/** The right edge: now, or the next full second for those who want less motion. */
function edge(now: number): number {
  return calm.matches ? Math.ceil(now) : now;
}

/** Where a line must not run: over a value that is missing, and over a time without samples. */
function holes(plot: uPlot, series: number, first: number, last: number, gaps: uPlot.Series.Gaps): uPlot.Series.Gaps {
  const times = plot.data[0];
  const values = plot.data[series]!;
  let shown = -1;
  for (let i = Math.max(0, first - 1); i <= last; i += 1) {
    if (Number.isNaN(values[i])) continue;
    if (shown >= 0 && (shown < i - 1 || times[i]! - times[shown]! > HOLE_S)) {
      gaps.push([plot.valToPos(times[shown]!, "x", true), plot.valToPos(times[i]!, "x", true)]);
    }
    shown = i;
  }
  return gaps;
}

function labels(splits: readonly number[]): string[] {
  const step = splits.length > 1 ? Math.abs(splits[1]! - splits[0]!) : 1;
  const digits = Math.max(0, Math.min(3, Math.ceil(-Math.log10(step) - 1e-9)));
  return splits.map((value) => {
    if (Math.abs(value) >= 10_000) return `${signed(value / 1000, Math.abs(step) % 1000 ? 1 : 0)}k`;
    return signed(value, digits);
  });
}

function signed(value: number, digits: number): string {
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && /[1-9]/.test(text) ? `\u2212${text}` : text;
}

function roundStep(step: number): number {
  const power = 10 ** Math.floor(Math.log10(step));
  const share = step / power;
  return (share <= 1 ? 1 : share <= 2 ? 2 : share <= 5 ? 5 : 10) * power;
}

function faint(rgb: string): string {
  return rgb.startsWith("rgb(") ? rgb.replace("rgb(", "rgba(").replace(")", ", 0.09)") : rgb;
}

function rem(times: number): number {
  return times * parseFloat(getComputedStyle(document.documentElement).fontSize);
}
