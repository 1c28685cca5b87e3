// A chart of a range by uPlot: of a past time, with the time of day below it, or of any other quantity.

import uPlot from "uplot";
import { el, setAttribute } from "../base/dom";
import { dayTime, number, when } from "../base/format";
import type { Range } from "../base/range";
import { colour, onTheme } from "../base/theme";
import { axis, faint, fit, holes, labels, PLAIN, paint, rem, roundRange, timeAxis } from "./axes";
import { gestures } from "./gestures";
import { type About, Spoken } from "./spoken";

export interface Curve {
  readonly label: string;
  /** The custom property of its colour. */
  readonly colour: string;
  readonly dash?: readonly number[];
  readonly right?: boolean;
  /** Draw a point for every value: a line would hide how sparse a series is. */
  readonly points?: boolean;
}

/** A place on the x axis with a short label, or all from there to another place. */
export interface Mark {
  readonly at: number;
  readonly label: string;
  readonly to?: number;
}

/** What a viewer does on a chart. Without it the chart only has a cursor. */
export interface Hands {
  /** The viewer has dragged over a range. */
  readonly zoom: (to: Range) => void;
  /** The viewer pans or zooms by wheel or fingers; as in `Gestures`. */
  readonly move: (to: Range, upright: boolean) => boolean;
  /** The viewer has clicked twice. */
  readonly back: () => void;
  /** The viewer has clicked. */
  readonly pick: () => void;
}

/** A value that the viewer drags up and down. */
export interface Threshold {
  readonly value: number;
  /** The line that it is of, by its place. */
  readonly line: number;
  readonly write: (value: number) => string;
  readonly moved: (value: number) => void;
}

export interface RangeChartOptions {
  readonly curves: readonly Curve[];
  /** Its title, and a value with its unit. */
  readonly about: Pick<About, "title" | "write">;
  readonly zero?: boolean;
  /** Charts with the same name share their cursor. */
  readonly sync?: string;
  /** A line has a gap after this much of x without a value. */
  readonly hole_s: number;
  /** Draw a band from minimum to maximum of the first curve: columns two and three of the data. */
  readonly band?: boolean;
  /** The unit of x; without it x is a time. */
  readonly unit?: string;
  readonly onCursor?: (index: number | null) => void;
  readonly hands?: Hands;
}

// A shorter drag is a click.
const LEAST_DRAG_PX = 5;
const NO_SELECTION = { left: 0, top: 0, width: 0, height: 0 };

export class RangeChart {
  private readonly plot: uPlot;
  private readonly spoken: Spoken;
  private readonly themed: () => void;
  private palette: string[] = [];
  private paint = paint();
  private marked = { line: "", label: "", font: "" };
  private range: Range;
  private hole_s: number;
  private marks: readonly Mark[] = [];
  /** What has moved the cursor last. */
  private pointed: MouseEvent | null = null;
  private threshold: Threshold | undefined;
  private readonly handle = el("div", {
    class: "threshold",
    role: "slider",
    tabindex: "0",
    "aria-orientation": "vertical",
    "aria-label": "Threshold",
  });

  constructor(host: HTMLElement, options: RangeChartOptions, data: uPlot.AlignedData, range: Range) {
    this.range = range;
    this.hole_s = options.hole_s;
    const read = (): void => {
      this.palette = options.curves.map((curve) => colour(curve.colour));
      this.paint = paint();
      const font = getComputedStyle(document.body).fontFamily;
      this.marked = { line: colour("--accent"), label: colour("--panel"), font };
    };
    read();
    const colours = () => this.paint;
    const rounded = (_: uPlot, low: number | null, high: number | null, scale: string): [number, number] => {
      if (low === null || high === null) return [0, 1];
      if (this.threshold && scale === this.limitScale)
        [low, high] = [Math.min(low, this.threshold.value), Math.max(high, this.threshold.value)];
      const span = Math.max(Math.abs(high) * 0.02, high === 0 && low === 0 ? 1 : 1e-6);
      return roundRange(low, high, span, options.zero ?? false);
    };
    const right = options.curves.some((curve) => curve.right);
    const series: uPlot.Series[] = options.curves.map((curve, i) => ({
      scale: curve.right ? "right" : "y",
      stroke: () => this.palette[i]!,
      width: 1.6,
      points: { show: curve.points ?? false, size: 4, fill: () => this.palette[i]! },
      gaps: holes(() => this.hole_s),
      ...(curve.dash ? { dash: [...curve.dash] } : {}),
    }));
    const edge: uPlot.Series = { stroke: "transparent", width: 0, points: { show: false } };
    const { hands } = options;
    this.plot = new uPlot(
      {
        ...PLAIN,
        width: Math.max(1, host.clientWidth),
        height: Math.max(1, host.clientHeight),
        padding: [rem(0.5), right ? 0 : rem(1.7), 0, 0],
        select: { ...PLAIN.select, show: hands !== undefined },
        cursor: {
          y: false,
          drag: { x: hands !== undefined, y: false, setScale: false },
          points: { size: 7, width: 0 },
          ...(options.sync ? { sync: { key: options.sync, setSeries: false } } : {}),
        },
        scales: {
          x: { time: false, auto: false, range: () => [...this.range] },
          y: { range: rounded },
          right: { range: rounded },
        },
        axes: [
          axis(colours, 1.5, 0.3, {
            space: rem(4.6),
            ...(options.unit === undefined
              ? timeAxis()
              : { values: (_, splits) => labels(splits).map((text) => `${text} ${options.unit}`) }),
          }),
          axis(colours, 3.1, 0.4, { space: rem(2.2), values: (_, splits) => labels(splits) }),
          ...(right
            ? [
                axis(colours, 3.1, 0.4, {
                  side: 1,
                  scale: "right",
                  space: rem(2.2),
                  grid: { show: false },
                  values: (_, splits) => labels(splits),
                }),
              ]
            : []),
        ],
        series: [{}, ...series, ...(options.band ? [edge, edge] : [])],
        ...(options.band ? { bands: [{ series: [3, 2], fill: () => faint(this.palette[0]!, 0.22) }] } : {}),
        hooks: {
          setCursor: [
            ({ cursor }) => {
              // A drawing, or the page, has moved the cursor of a chart with hands: only a pointer's word counts.
              if (hands && cursor.event === this.pointed) return;
              this.pointed = cursor.event ?? null;
              options.onCursor?.(cursor.idx ?? null);
            },
          ],
          setSelect: [(plot) => this.selected(plot, hands)],
          draw: [(plot) => this.drawMarks(plot), () => this.placeHandle()],
        },
      },
      data,
      host,
    );
    const { unit } = options;
    this.spoken = new Spoken(host, this.plot, {
      ...options.about,
      lines: options.curves.map(({ label }) => label),
      range: () =>
        unit === undefined
          ? `${dayTime(this.range[0])} to ${when(this.range[1])}`
          : `${number(this.range[0], 2)} to ${number(this.range[1], 2)} ${unit}`,
      at: (x) => (unit === undefined ? dayTime(x, { fractionalSecondDigits: 1 }) : `${number(x, 2)} ${unit}`),
      timeless: unit !== undefined,
      band: options.band ?? false,
      ...(hands ? { keyed: (index) => options.onCursor?.(index), rested: hands.pick } : {}),
    });
    if (hands) this.listen(host, hands);
    this.holdHandle();
    fit(host, this.plot, () => {});
    this.themed = onTheme(() => {
      read();
      this.plot.redraw(false, true);
    });
  }

  /** Show other data of the same curves. */
  set(data: uPlot.AlignedData, range: Range, hole_s: number): void {
    this.hole_s = hole_s;
    this.range = range;
    this.plot.setData(data);
    this.spoken.changed();
  }

  /** Show another range of the same data. */
  move(range: Range): void {
    this.range = range;
    this.plot.setScale("x", { min: range[0], max: range[1] });
    this.spoken.changed();
  }

  /** Draw a line with its label at each of these places. */
  mark(marks: readonly Mark[]): void {
    this.marks = marks;
    this.plot.redraw(false);
  }

  /** Show a threshold that the viewer drags, or moves with the keys; undefined removes it. */
  set limit(threshold: Threshold | undefined) {
    this.threshold = threshold;
    if (!threshold) this.handle.remove();
    // Beside the chart, which is one picture to whoever does not see it.
    else if (!this.handle.isConnected) this.plot.root.parentElement!.after(this.handle);
    // The axis reaches to it; while it is dragged, the axis stays.
    if (this.handle.matches(":active")) this.placeHandle();
    else this.plot.setData(this.plot.data);
  }

  private get limitScale(): string {
    return this.plot.series[(this.threshold?.line ?? 0) + 1]?.scale ?? "y";
  }

  private placeHandle(): void {
    const { threshold, plot, handle } = this;
    if (!threshold) return;
    const { min = 0, max = 1 } = plot.scales[this.limitScale] ?? {};
    const top = plot.valToPos(threshold.value, this.limitScale);
    const [over, around] = [plot.over, handle.parentElement!].map((node) => node.getBoundingClientRect());
    handle.style.width = `${over!.width}px`;
    const y = over!.top - around!.top + Math.max(0, Math.min(over!.height, top));
    handle.style.translate = `${(over!.left - around!.left).toFixed(1)}px ${y.toFixed(1)}px`;
    setAttribute(handle, "aria-valuenow", String(threshold.value));
    setAttribute(handle, "aria-valuemin", String(Math.min(min ?? 0, threshold.value)));
    setAttribute(handle, "aria-valuemax", String(Math.max(max ?? 1, threshold.value)));
    setAttribute(handle, "aria-valuetext", threshold.write(threshold.value));
  }

  private holdHandle(): void {
    const { handle, plot } = this;
    handle.addEventListener("pointerdown", (event) => handle.setPointerCapture(event.pointerId));
    handle.addEventListener("pointermove", (event) => {
      if (!handle.hasPointerCapture(event.pointerId)) return;
      const y = event.clientY - plot.over.getBoundingClientRect().top;
      this.threshold?.moved(plot.posToVal(Math.max(0, Math.min(plot.over.clientHeight, y)), this.limitScale));
    });
    handle.addEventListener("keydown", (event) => {
      const { min, max } = plot.scales[this.limitScale] ?? {};
      const step = ((max ?? 1) - (min ?? 0)) / (event.shiftKey ? 10 : 100);
      const by = { ArrowUp: step, ArrowDown: -step }[event.key];
      if (by === undefined || !this.threshold) return;
      this.threshold.moved(this.threshold.value + by);
      event.preventDefault();
      event.stopPropagation();
    });
  }

  /** Put the cursor on a row. */
  point(index: number): void {
    // After uPlot has drawn new data or another range, in a microtask of its own.
    queueMicrotask(() => {
      const at = this.plot.data[0][index];
      if (at !== undefined) this.plot.setCursor({ left: this.plot.valToPos(at, "x"), top: 0 }, false);
    });
  }

  destroy(): void {
    this.themed();
    this.handle.remove();
    this.plot.destroy();
  }

  private listen(host: HTMLElement, hands: Hands): void {
    host.addEventListener("keydown", (event) => {
      if (event.key === "-") hands.back();
      if (event.key === "Enter") hands.pick();
      if (event.key !== "+") return;
      const [from, to] = this.range;
      const at = this.plot.data[0][this.plot.cursor.idx ?? -1] ?? (from + to) / 2;
      hands.zoom([at - (at - from) / 2, at + (to - at) / 2]);
    });
    const { over } = this.plot;
    let at = 0;
    over.addEventListener("mousedown", (event) => (at = event.clientX));
    over.addEventListener("click", (event) => Math.abs(event.clientX - at) < LEAST_DRAG_PX && hands.pick());
    over.addEventListener("dblclick", () => hands.back());
    gestures(over, { range: () => this.range, move: hands.move });
  }

  private drawMarks({ ctx, bbox, valToPos }: uPlot): void {
    const size = rem(0.8) * devicePixelRatio;
    ctx.save();
    ctx.font = `600 ${Math.round(size * 0.9)}px ${this.marked.font}`;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    const right = bbox.left + bbox.width;
    for (const { at, label, to = at } of this.marks) {
      const [begin, end] = [valToPos(at, "x", true), valToPos(to, "x", true)];
      if (end < bbox.left || begin > right) continue;
      // What begins before the range has its label at the range's start.
      const x = Math.max(bbox.left, Math.round(begin));
      ctx.fillStyle = faint(this.marked.line, 0.14);
      ctx.fillRect(x, bbox.top, Math.min(end, right) - x, bbox.height);
      ctx.fillStyle = this.marked.line;
      ctx.fillRect(x, bbox.top, Math.max(1, devicePixelRatio), bbox.height);
      const width = ctx.measureText(label).width + size * 0.6;
      ctx.fillRect(x - width / 2, bbox.top, width, size * 1.1);
      ctx.fillStyle = this.marked.label;
      ctx.fillText(label, x, bbox.top + size * 0.12);
    }
    ctx.restore();
  }

  private selected(plot: uPlot, hands: Hands | undefined): void {
    const { left, width } = plot.select;
    if (width <= 0) return;
    plot.setSelect(NO_SELECTION, false);
    if (width >= LEAST_DRAG_PX) hands?.zoom([plot.posToVal(left, "x"), plot.posToVal(left + width, "x")]);
  }
}
