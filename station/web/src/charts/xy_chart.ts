// One quantity over another: the newest point and its track, which fades.

import uPlot from "uplot";
import { setAttribute } from "../base/dom";
import { number } from "../base/format";
import { colour, onTheme } from "../base/theme";
import { axis, faint, fit, labels, PLAIN, paint, rem, roundRange } from "./axes";
import { AGAIN_MS, extremes } from "./spoken";

export interface XYChartOptions {
  readonly title: string;
  /** A text, or a function that gives one when the chart is drawn. */
  readonly x: string | (() => string);
  readonly y: string | (() => string);
  /** The minimum range of each axis. */
  readonly span: readonly [number, number];
  /** Both axes include zero. */
  readonly zero?: boolean;
  /** Both axes have the same scale, as on a map. */
  readonly equal?: boolean;
  /** The edges of the ground below the track; it is left out while the newest point is far from it. */
  readonly ground?: readonly [Track, Track];
}

/** Points in the order of time, the newest last. */
export interface Track {
  readonly x: ArrayLike<number>;
  readonly y: ArrayLike<number>;
}

const FRAME_S = 0.1;
const SHADES = 12;

export class XYChart {
  protected readonly plot: uPlot;
  private readonly offTheme: () => void;
  protected track: Track = { x: [], y: [] };
  private grounded = false;
  private visible = true;
  private drawnAt = -Infinity;
  protected ink = "";
  private paint = paint();
  private writtenAt = -Infinity;
  private bounds: { x: [number, number]; y: [number, number] };
  /** A line on the ground, such as the fastest one. */
  protected line: Track | undefined;

  constructor(
    protected readonly host: HTMLElement,
    private readonly options: XYChartOptions,
  ) {
    host.setAttribute("role", "img");
    this.write();
    this.bounds = { x: [0, options.span[0]], y: [0, options.span[1]] };
    this.ink = colour("--accent");
    const colours = () => this.paint;
    const named = (
      label: string | (() => string),
      font = `${Math.round(rem(0.72))}px ${getComputedStyle(document.body).fontFamily}`,
    ): uPlot.Axis => ({
      label,
      labelFont: font,
      labelSize: rem(1.1),
      labelGap: 0,
    });
    this.plot = new uPlot(
      {
        ...PLAIN,
        width: Math.max(1, host.clientWidth),
        height: Math.max(1, host.clientHeight),
        padding: [rem(0.5), rem(0.9), 0, 0],
        cursor: { show: false },
        scales: {
          x: { time: false, auto: false, range: () => this.bounds.x },
          y: { auto: false, range: () => this.bounds.y },
        },
        axes: [
          axis(colours, 1.4, 0.3, {
            ...named(options.x),
            values: (_, splits) => labels(splits),
            space: rem(3),
          }),
          axis(colours, 2.9, 0.4, {
            ...named(options.y),
            values: (_, splits) => labels(splits),
            space: rem(2),
          }),
        ],
        series: [{}, { show: true, paths: () => null, points: { show: false } }],
        hooks: { draw: [(plot) => this.drawAll(plot)] },
      },
      [[0], [0]],
      host,
    );
    fit(host, this.plot, (visible) => {
      this.visible = visible;
      this.drawnAt = -Infinity;
      this.changed();
    });
    this.offTheme = onTheme(() => {
      [this.ink, this.paint] = [colour("--accent"), paint()];
      this.drawnAt = -Infinity;
      this.changed();
    });
  }

  /** The chart has another size or theme. A live one is drawn again anyway. */
  protected changed(): void {}

  destroy(): void {
    this.offTheme();
    this.plot.destroy();
  }

  due(now: number): boolean {
    return this.visible && now - this.drawnAt >= FRAME_S;
  }

  draw(now: number, track: () => Track): void {
    if (!this.due(now)) return;
    this.drawnAt = now;
    this.show(track());
    if (performance.now() - this.writtenAt >= AGAIN_MS) this.write();
  }

  /** Draw this track, and choose the axes for it. */
  protected show(track: Track): void {
    this.track = track;
    this.setBounds();
    this.plot.batch(() => {
      this.plot.setScale("x", { min: this.bounds.x[0], max: this.bounds.x[1] });
      this.plot.setScale("y", { min: this.bounds.y[0], max: this.bounds.y[1] });
      this.plot.redraw(false, true);
    });
  }

  /** Say in words what the chart shows. */
  protected write(): void {
    this.writtenAt = performance.now();
    const { title, x, y } = this.options;
    const named = (name: typeof x): string => (typeof name === "string" ? name : name());
    const axes = [
      [named(x), this.track.x],
      [named(y), this.track.y],
    ] as const;
    const figures = axes.map(([name, values]) => {
      const { newest, least, most } = extremes(values);
      return Number.isNaN(newest)
        ? `${name}: no values`
        : `${name}: newest ${number(newest, 2)}, minimum ${number(least, 2)}, maximum ${number(most, 2)}`;
    });
    setAttribute(this.host, "aria-label", `Chart ${title}. ${figures.join("; ")}.`);
  }

  private setBounds(): void {
    const { span, zero = false, equal, ground } = this.options;
    let [x, y] = [extent(this.track.x), extent(this.track.y)];
    this.grounded = ground !== undefined && this.near(ground);
    if (ground && this.grounded) {
      x = extent([...x, ...ground.flatMap((edge) => extent(edge.x))]);
      y = extent([...y, ...ground.flatMap((edge) => extent(edge.y))]);
    }
    if (equal) {
      const { width, height } = this.plot.bbox;
      const scale =
        Math.max((x[1] - x[0]) / width, (y[1] - y[0]) / height, span[0] / width, span[1] / height) * 1.08;
      const around = ([low, high]: [number, number], size: number): [number, number] => {
        const middle = (low + high) / 2;
        return [middle - (size * scale) / 2, middle + (size * scale) / 2];
      };
      [x, y] = [around(x, width), around(y, height)];
    } else {
      x = roundRange(x[0], x[1], span[0], zero);
      y = roundRange(y[0], y[1], span[1], zero);
    }
    this.bounds = { x, y };
  }

  /** Whether the newest point is on the ground, or less than half its size away: another frame is elsewhere. */
  private near(ground: readonly [Track, Track]): boolean {
    return (["x", "y"] as const).every((axis) => {
      const values = this.track[axis];
      const [low, high] = extent(ground.flatMap((edge) => extent(edge[axis])));
      return Math.abs((values[values.length - 1] ?? NaN) - (low + high) / 2) <= high - low;
    });
  }

  private drawGround(plot: uPlot, [left, right]: readonly [Track, Track]): void {
    const { ctx } = plot;
    ctx.beginPath();
    for (const edge of [left, right]) this.trace(edge);
    ctx.fillStyle = this.paint.grid;
    ctx.fill("evenodd");
    ctx.strokeStyle = this.paint.text;
    ctx.lineWidth = uPlot.pxRatio;
    ctx.stroke();
    if (!this.line) return;
    ctx.beginPath();
    this.trace(this.line);
    ctx.setLineDash([6 * uPlot.pxRatio, 4 * uPlot.pxRatio]);
    ctx.stroke();
    ctx.setLineDash([]);
  }

  private trace({ x, y }: Track): void {
    const { plot } = this;
    for (let i = 0; i < x.length; i += 1) {
      const [px, py] = [plot.valToPos(x[i]!, "x", true), plot.valToPos(y[i]!, "y", true)];
      if (i === 0) plot.ctx.moveTo(px, py);
      else plot.ctx.lineTo(px, py);
    }
  }

  private drawAll(plot: uPlot): void {
    const { ctx } = plot;
    const { left, top, width, height } = plot.bbox;
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, width, height);
    ctx.clip();
    if (this.grounded) this.drawGround(plot, this.options.ground!);
    ctx.lineWidth = 1.75 * uPlot.pxRatio;
    ctx.lineJoin = "round";
    this.drawTrack(plot);
    ctx.restore();
  }

  /** Draw the track alone, clipped to the plot. */
  protected drawTrack(plot: uPlot): void {
    const { x, y } = this.track;
    const { ctx } = plot;
    // A few shades from old to new: a stroke for each point would be slow.
    for (let shade = 0; shade < SHADES; shade += 1) {
      const from = Math.floor((x.length * shade) / SHADES);
      const to = Math.min(x.length - 1, Math.floor((x.length * (shade + 1)) / SHADES));
      ctx.beginPath();
      let down = false;
      for (let i = from; i <= to; i += 1) {
        const [px, py] = [plot.valToPos(x[i]!, "x", true), plot.valToPos(y[i]!, "y", true)];
        if (Number.isNaN(px + py)) down = false;
        else if (down) ctx.lineTo(px, py);
        else {
          ctx.moveTo(px, py);
          down = true;
        }
      }
      ctx.strokeStyle = faint(this.ink, 0.08 + (0.92 * (shade + 1)) / SHADES);
      ctx.stroke();
    }
    const last = x.length - 1;
    if (last >= 0 && !Number.isNaN(x[last]! + y[last]!)) {
      ctx.beginPath();
      ctx.arc(
        plot.valToPos(x[last]!, "x", true),
        plot.valToPos(y[last]!, "y", true),
        4.5 * uPlot.pxRatio,
        0,
        2 * Math.PI,
      );
      ctx.fillStyle = this.ink;
      ctx.fill();
    }
  }
}

function extent(values: ArrayLike<number>): [number, number] {
  let [low, high] = [Infinity, -Infinity];
  for (let i = 0; i < values.length; i += 1) {
    const value = values[i]!;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low <= high ? [low, high] : [0, 0];
}
