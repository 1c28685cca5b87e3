// A chart of a past range by uPlot, with the time of day below it.

import uPlot from "uplot";
import { axis, faint, fit, holes, labels, paint, PLAIN, rem, roundRange } from "./axes";
import { colour, onTheme } from "../base/theme";

export interface Curve {
  readonly label: string;
  /** The custom property of its colour. */
  readonly colour: string;
  readonly dash?: readonly number[];
  readonly right?: boolean;
  /** Draw a point for every value: a line would hide how sparse a series is. */
  readonly points?: boolean;
}

export interface RangeChartOptions {
  readonly curves: readonly Curve[];
  readonly zero?: boolean;
  /** Charts with the same name share their cursor. */
  readonly sync?: string;
  /** A line has a gap after this time without a value. */
  readonly hole_s: number;
  /** Draw a band from minimum to maximum of the first curve: columns two and three of the data. */
  readonly band?: boolean;
  readonly onCursor?: (index: number | null) => void;
}

const TIME = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" } as const;

export class RangeChart {
  private readonly plot: uPlot;
  private palette: string[] = [];
  private paint = paint();

  constructor(host: HTMLElement, options: RangeChartOptions, data: uPlot.AlignedData, range: readonly [number, number]) {
    const read = (): void => {
      this.palette = options.curves.map((curve) => colour(curve.colour));
      this.paint = paint();
    };
    read();
    const colours = () => this.paint;
    const rounded = (_: uPlot, low: number | null, high: number | null): [number, number] =>
      low === null || high === null ? [0, 1] : roundRange(low, high, Math.max(Math.abs(high) * 0.02, high === 0 && low === 0 ? 1 : 1e-6), options.zero ?? false);
    const right = options.curves.some((curve) => curve.right);
    const series: uPlot.Series[] = options.curves.map((curve, i) => ({
      scale: curve.right ? "right" : "y",
      stroke: () => this.palette[i]!,
      width: 1.6,
      points: { show: curve.points ?? false, size: 4, fill: () => this.palette[i]! },
      gaps: holes(() => options.hole_s),
      ...(curve.dash ? { dash: [...curve.dash] } : {}),
    }));
    const edge: uPlot.Series = { stroke: "transparent", width: 0, points: { show: false } };
    this.plot = new uPlot(
      {
        ...PLAIN,
        width: Math.max(1, host.clientWidth),
        height: Math.max(1, host.clientHeight),
        padding: [rem(0.5), right ? 0 : rem(1.7), 0, 0],
        cursor: {
          y: false,
          drag: { x: false, y: false, setScale: false },
          points: { size: 7, width: 0 },
          ...(options.sync ? { sync: { key: options.sync, setSeries: false } } : {}),
        },
        scales: { x: { time: true, auto: false, range: () => [...range] }, y: { range: rounded }, right: { range: rounded } },
        axes: [
          axis(colours, 1.5, 0.3, { space: rem(5), values: (_, splits) => timeLabels(splits) }),
          axis(colours, 3.1, 0.4, { space: rem(2.2), values: (_, splits) => labels(splits) }),
          ...(right ? [axis(colours, 3.1, 0.4, { side: 1, scale: "right", space: rem(2.2), grid: { show: false }, values: (_, splits) => labels(splits) })] : []),
        ],
        series: [{}, ...series, ...(options.band ? [edge, edge] : [])],
        ...(options.band ? { bands: [{ series: [3, 2], fill: () => faint(this.palette[0]!, 0.22) }] } : {}),
        hooks: { setCursor: [(plot) => options.onCursor?.(plot.cursor.idx ?? null)] },
      },
      data,
      host,
    );
    fit(host, this.plot, () => {});
    onTheme(() => {
      read();
      this.plot.redraw(false, true);
    });
  }

  /** Put the cursor on a row. */
  point(index: number): void {
    const at = this.plot.data[0][index];
    if (at !== undefined) this.plot.setCursor({ left: this.plot.valToPos(at, "x"), top: 0 }, false);
  }

  destroy(): void {
    this.plot.destroy();
  }
}

function timeLabels(splits: readonly number[]): string[] {
  const seconds = splits.length > 1 && splits[1]! - splits[0]! < 60;
  const format = new Intl.DateTimeFormat("en-GB", seconds ? { ...TIME, second: "2-digit" } : TIME);
  return splits.map((at) => format.format(at * 1000));
}
