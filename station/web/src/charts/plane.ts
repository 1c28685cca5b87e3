// What was, as points of a plane: a way on its ground, or one quantity over another, in colours. The cursor is a mark on
// it, which moves without a drawing; pointing at a point, or the arrow keys, move the cursor.

import uPlot from "uplot";
import { el } from "../base/dom";
import { dayTime } from "../base/format";
import { lastAt, type Range } from "../base/range";
import { colour, onTheme } from "../base/theme";
import { chorded, speak, stepped } from "./spoken";
import { type Track, XYChart, type XYChartOptions } from "./xy_chart";

/** Points in the order of time. What has no place is NaN. */
export interface Points extends Track {
  readonly t: readonly number[];
  /** The colour of each point, from 0 to 1; NaN for none. */
  readonly shades?: ArrayLike<number> | undefined;
  /** A line has a gap after this time without a point. */
  readonly hole: number;
}

export interface PlaneOptions extends XYChartOptions {
  /** Points alone, without a line from each to the next. */
  readonly dots?: boolean;
  /** The viewer points at a time; null when that ends. */
  readonly onPoint: (at: number | null) => void;
  /** The viewer rests there. */
  readonly pick: () => void;
  /** The point in words. */
  readonly told: (index: number) => string;
}

export const RAMP = ["--ramp-1", "--ramp-2", "--ramp-3", "--ramp-4", "--ramp-5"] as const;
const SHADES = 24;
// Points that are about as near as the nearest one: of several laps, the one under the cursor goes on.
const NEAR_PX = 6;
const FAR_PX = 40;

export class Plane extends XYChart {
  private points: Points = { x: [], y: [], t: [], hole: 1 };
  private range: Range = [0, 1];
  private readonly car = el("div", { class: "plane-mark", hidden: "" });
  private readonly offRamp: () => void;
  private ramp: readonly string[] = [];
  private index = -1;
  /** A key has moved the mark. */
  private keyed = false;

  constructor(
    host: HTMLElement,
    private readonly more: PlaneOptions,
  ) {
    super(host, more);
    const read = (): void => {
      this.ramp = ramp(RAMP.map(colour));
    };
    read();
    this.offRamp = onTheme(read);
    this.plot.over.append(this.car);
    host.tabIndex = 0;
    this.listen();
  }

  set(points: Points, range: Range): void {
    [this.points, this.range] = [points, range];
    this.index = -1;
    this.show(points);
    this.write();
  }

  /** Show what is in another range of the same points. */
  move(range: Range): void {
    this.range = range;
    this.plot.redraw(false);
  }

  /** Put the mark where it was at a time. */
  point(at: number): void {
    this.index = lastAt(this.points.t, at);
    this.place();
  }

  /** Draw a line on the ground. */
  ground(line: Track | undefined): void {
    this.line = line;
    this.plot.redraw(false);
  }

  override destroy(): void {
    this.offRamp();
    super.destroy();
  }

  protected override changed(): void {
    this.show(this.points);
    this.place();
  }

  protected override drawTrack(plot: uPlot): void {
    const { x, y, t, shades, hole } = this.points;
    const { ctx } = plot;
    const [from, to] = this.range;
    const [first, last] = [lastAt(t, from), lastAt(t, to)];
    const ratio = uPlot.pxRatio;
    // A stroke for each colour: one for each point would be slow.
    const paths = new Map<string, Path2D>();
    let [px, py, before] = [NaN, NaN, -Infinity];
    let end: Path2D | undefined;
    for (let i = Math.max(0, first); i <= last; i += 1) {
      const [nx, ny] = [plot.valToPos(x[i]!, "x", true), plot.valToPos(y[i]!, "y", true)];
      if (Number.isNaN(nx + ny)) continue;
      const shade = shades?.[i] ?? NaN;
      const ink = Number.isNaN(shade) ? this.ink : this.ramp[Math.round(shade * (SHADES - 1))]!;
      let path = paths.get(ink);
      if (!path) paths.set(ink, (path = new Path2D()));
      if (this.more.dots) path.rect(nx - ratio, ny - ratio, 2 * ratio, 2 * ratio);
      else if (t[i]! - before <= hole) {
        if (path !== end) path.moveTo(px, py);
        path.lineTo(nx, ny);
        end = path;
      } else end = undefined;
      [px, py, before] = [nx, ny, t[i]!];
    }
    ctx.lineWidth = 2 * ratio;
    ctx.lineCap = "round";
    for (const [ink, path] of paths) {
      [ctx.strokeStyle, ctx.fillStyle] = [ink, ink];
      if (this.more.dots) ctx.fill(path);
      else ctx.stroke(path);
    }
  }

  private place(): void {
    const { car, plot, index } = this;
    const [x, y] = this.pixels(index);
    car.hidden = Number.isNaN(x + y);
    if (car.hidden) return;
    const [ax, ay] = this.pixels(Math.max(0, index - 1));
    const [bx, by] = this.pixels(Math.min(this.points.t.length - 1, index + 1));
    const turned = this.more.dots || Math.hypot(bx - ax, by - ay) < 0.5;
    if (!turned && !Number.isNaN(bx - ax + by - ay))
      car.style.rotate = `${Math.atan2(by - ay, bx - ax).toFixed(3)}rad`;
    car.dataset.dot = String(this.more.dots ?? false);
    car.style.translate = `${x.toFixed(1)}px ${y.toFixed(1)}px`;
    const { width, height } = plot.bbox;
    car.hidden = x < 0 || y < 0 || x > width / uPlot.pxRatio || y > height / uPlot.pxRatio;
  }

  private pixels(index: number): readonly [number, number] {
    const { x, y } = this.points;
    const { plot } = this;
    return [plot.valToPos(x[index] ?? NaN, "x"), plot.valToPos(y[index] ?? NaN, "y")];
  }

  private listen(): void {
    const { host, plot, more } = this;
    const { over } = plot;
    // A pointer moves more often than a picture is drawn.
    let pointed: PointerEvent | undefined;
    const moved = (event: PointerEvent): void => {
      if (!pointed)
        requestAnimationFrame(() => {
          if (pointed) this.nearest(pointed);
          pointed = undefined;
        });
      pointed = event;
    };
    over.addEventListener("pointermove", moved);
    over.addEventListener("pointerdown", moved);
    over.addEventListener("pointerleave", () => {
      pointed = undefined;
      more.onPoint(null);
    });
    over.addEventListener("click", more.pick);
    host.addEventListener("keydown", (event) => this.key(event));
    host.addEventListener("blur", () => {
      if (this.keyed) more.pick();
      this.keyed = false;
    });
  }

  /** Point at the point below the pointer. */
  private nearest(event: PointerEvent): void {
    const { points, plot, range } = this;
    const box = plot.over.getBoundingClientRect();
    const [mx, my] = [event.clientX - box.left, event.clientY - box.top];
    const { min: x0 = 0, max: x1 = 1 } = plot.scales.x!;
    const { min: y0 = 0, max: y1 = 1 } = plot.scales.y!;
    const [sx, sy] = [box.width / (x1! - x0!), box.height / (y1! - y0!)];
    const away = (i: number): number =>
      Math.hypot((points.x[i]! - x0!) * sx - mx, (y1! - points.y[i]!) * sy - my);
    const [first, last] = [Math.max(0, lastAt(points.t, range[0])), lastAt(points.t, range[1])];
    let least = Infinity;
    for (let i = first; i <= last; i += 1) least = Math.min(least, away(i) || Infinity);
    if (least > FAR_PX) return;
    let found = -1;
    for (let i = first; i <= last; i += 1)
      if (
        away(i) <= least + NEAR_PX &&
        (found < 0 || Math.abs(i - this.index) < Math.abs(found - this.index))
      )
        found = i;
    if (found >= 0) this.more.onPoint(points.t[found]!);
  }

  private key(event: KeyboardEvent): void {
    if (chorded(event)) return;
    const { t } = this.points;
    const [first, last] = [Math.max(0, lastAt(t, this.range[0])), lastAt(t, this.range[1])];
    const to = stepped(event, this.index < 0 ? last + 1 : this.index, first, last);
    if (event.key === "Enter") this.more.pick();
    else if (event.key === "Escape") {
      this.keyed = false;
      this.more.onPoint(null);
    } else if (to === undefined) return;
    else {
      [this.keyed, this.index] = [true, to];
      this.more.onPoint(t[to]!);
      speak(`${dayTime(t[to]!, { fractionalSecondDigits: 1 })}: ${this.more.told(to)}`);
    }
    event.preventDefault();
    event.stopPropagation();
  }
}

/** Colours from the first to the last one, as `rgb(…)`. */
function ramp(stops: readonly string[]): string[] {
  const parts = stops.map((stop) => stop.match(/[\d.]+/g)!.map(Number));
  return Array.from({ length: SHADES }, (_, i) => {
    const at = (i / (SHADES - 1)) * (parts.length - 1);
    const [one, other] = [parts[Math.floor(at)]!, parts[Math.ceil(at)]!];
    return `rgb(${one.slice(0, 3).map((each, c) => Math.round(each + (other[c]! - each) * (at % 1)))})`;
  });
}
