// Common parts of the charts: fonts, colours, axes and round numbers.

import type uPlot from "uplot";
import { colour } from "../base/theme";
import { type Mark, timeMarks } from "./time_axis";

export interface Paint {
  text: string;
  grid: string;
}

/** The size of the labels, in rem. */
export const FONT = 0.72;
// The part of a range that is left free above and below.
const ROOM = 0.04;

export const calm = (): boolean => window.matchMedia("(prefers-reduced-motion: reduce)").matches;

export function paint(): Paint {
  return { text: colour("--muted"), grid: colour("--grid") };
}

/** The root's font size, which is asked for again after a second: within a frame that costs a layout of its styles. */
const root = { px: 16, at: -Infinity };

export function rem(times: number): number {
  const now = performance.now();
  if (now - root.at > 1000) {
    root.px = parseFloat(getComputedStyle(document.documentElement).fontSize);
    root.at = now;
  }
  return times * root.px;
}

export function axis(colours: () => Paint, size: number, gap: number, more: uPlot.Axis): uPlot.Axis {
  return {
    font: `${Math.round(rem(FONT))}px ${getComputedStyle(document.body).fontFamily}`,
    size: rem(size),
    gap: rem(gap),
    stroke: () => colours().text,
    grid: { stroke: () => colours().grid, width: 1 },
    ticks: { show: false },
    ...more,
  };
}

/** The marks of an axis of time: as many as have room. */
export function timeAxis(): Pick<uPlot.Axis, "splits" | "values"> {
  let marks: readonly Mark[] = [];
  return {
    splits: ({ bbox }, _, from, to) => {
      const width = bbox.width / devicePixelRatio;
      // A digit is a bit wider than half its height; two stay free between labels.
      marks = timeMarks(from, to, (chars) => Math.floor(width / ((chars + 2) * rem(FONT) * 0.6)));
      return marks.map(({ at }) => at);
    },
    values: () => marks.map(({ label }) => label),
  };
}

/** Parts of uPlot that no chart uses. */
export const PLAIN = {
  legend: { show: false },
  select: { show: false, left: 0, top: 0, width: 0, height: 0 },
} as const;

/** Keep a plot as large as its host, and report whether it is on the screen. */
export function fit(host: HTMLElement, plot: uPlot, changed: (visible: boolean) => void): void {
  new ResizeObserver(() => {
    if (host.clientWidth > 0) plot.setSize({ width: host.clientWidth, height: host.clientHeight });
    changed(true);
  }).observe(host);
  new IntersectionObserver((entries) => changed(entries.at(-1)?.isIntersecting ?? true)).observe(host);
}

export function labels(splits: readonly number[]): string[] {
  const step = splits.length > 1 ? Math.abs(splits[1]! - splits[0]!) : 1;
  // As many as the step needs: 2.5 has one, 0.25 two.
  const digits =
    [0, 1, 2].find((places) => Math.abs(step * 10 ** places - Math.round(step * 10 ** places)) < 1e-6) ?? 3;
  return splits.map((value) => {
    if (Math.abs(value) >= 10_000) return `${signed(value / 1000, Math.abs(step) % 1000 ? 1 : 0)}k`;
    return signed(value, Math.abs(value / step - Math.round(value / step)) > 0.01 ? digits + 1 : digits);
  });
}

function signed(value: number, digits: number): string {
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && /[1-9]/.test(text) ? `\u2212${text}` : text;
}

export function roundStep(step: number): number {
  const power = 10 ** Math.floor(Math.log10(step));
  const share = step / power;
  return (share <= 1 ? 1 : share <= 2 ? 2 : share <= 5 ? 5 : 10) * power;
}

/** A range of round numbers around `least` to `most`, of at least `span` and with room at its ends; with `zero` it includes zero. */
export function roundRange(least: number, most: number, span: number, zero: boolean): [number, number] {
  if (zero) [least, most] = [Math.min(0, least), Math.max(0, most)];
  const missing = span - (most - least);
  if (missing > 0 && zero && least === 0) most += missing;
  else if (missing > 0) [least, most] = [least - missing / 2, most + missing / 2];
  // A line at the edge of a chart looks cut off. Zero is an edge that few values cross.
  const room = (most - least) * ROOM;
  [least, most] = [
    least < 0 ? least - room : Math.max(0, least - room),
    most > 0 ? most + room : Math.min(0, most + room),
  ];
  const step = roundStep((most - least) / 8);
  return [Math.floor(least / step + 1e-9) * step, Math.ceil(most / step - 1e-9) * step];
}

export function faint(rgb: string, share = 0.09): string {
  return rgb.startsWith("rgb(") ? rgb.replace("rgb(", "rgba(").replace(")", `, ${share})`) : rgb;
}

/** The gaps of a line: missing values, and times without samples. What is undefined is a row of another line. */
export function holes(hole_s: () => number) {
  return (
    plot: uPlot,
    series: number,
    first: number,
    last: number,
    gaps: uPlot.Series.Gaps,
  ): uPlot.Series.Gaps => {
    const times = plot.data[0];
    const values = plot.data[series]!;
    let [shown, missing] = [-1, false];
    for (let i = Math.max(0, first - 1); i <= last; i += 1) {
      const value = values[i];
      if (value === undefined) continue;
      if (value === null || Number.isNaN(value)) {
        missing = true;
        continue;
      }
      if (shown >= 0 && (missing || times[i]! - times[shown]! > hole_s())) {
        gaps.push([plot.valToPos(times[shown]!, "x", true), plot.valToPos(times[i]!, "x", true)]);
      }
      [shown, missing] = [i, false];
    }
    return gaps;
  };
}
