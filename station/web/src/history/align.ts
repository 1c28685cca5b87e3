// Puts several ranges on one axis: the time since each began, or the distance since then.

import { type HistoryAnswer, TACHOMETER_COUNTS, type Value } from "../base/contract";
import { type Linear, linear, POSITIONS } from "../base/format";

export type Axis = "time" | "distance";

/** A column of a part, over x, which grows. */
export interface Line {
  readonly x: readonly number[];
  readonly y: readonly (number | null)[];
}

// Fields that count the way, or hold a position; the first that a stream has is used.
const COUNTERS = ["distance_traveled", "displacement"];
// A count that changes faster has begun anew, after a restart of its VESC.
const MOST_MPS = 100;
// A computer that was busy takes the samples that waited all at once: their times say nothing of a speed.
const LEAST_STEP_S = 0.1;
// Shorter steps between positions count once they add up: they may be the noise of a car that stands.
const LEAST_STEP_M = 0.1;
/**
 * The metres driven since the first row: from the tachometer, the position, or the speed; undefined without any of
 * them. `speed` is the car's, of its motor's speed: the tachometer needs it too.
 */
export function distance({ times_s, fields }: HistoryAnswer, speed?: Linear): number[] | undefined {
  const column = (name: string): readonly Value[] | undefined =>
    Object.hasOwn(fields, name) ? fields[name]!.mean : undefined;
  const rows = times_s.length;
  const counter = COUNTERS.map(column).find((values) => values !== undefined);
  if (counter && speed) {
    // Counts over counts of a revolution are revolutions; at 1 m/s a minute has as many as the gain, 1 / scale.
    const metres = Math.abs(speed.scale) * (60 / TACHOMETER_COUNTS);
    return summed(rows, [counter], (i, before) => {
      const step = Math.abs(Number(counter[i]) - Number(counter[before])) * metres;
      return step > MOST_MPS * Math.max(LEAST_STEP_S, times_s[i]! - times_s[before]!) ? 0 : step;
    });
  }
  for (const path of POSITIONS) {
    const [x, y] = [column(`${path}x`), column(`${path}y`)];
    if (!x || !y) continue;
    let from = -1;
    return summed(rows, [x, y], (i, before) => {
      if (from < 0) from = before;
      const step = Math.hypot(Number(x[i]) - Number(x[from]), Number(y[i]) - Number(y[from]));
      if (step < LEAST_STEP_M) return 0;
      from = i;
      return step;
    });
  }
  const erpm = column("speed");
  if (!erpm || !speed) return undefined;
  return summed(
    rows,
    [erpm],
    (i, before) => Math.abs(linear(Number(erpm[i]), speed)) * (times_s[i]! - times_s[before]!),
  );
}

/** The running sum of the steps from one row to the next in which all columns are numbers. */
function summed(
  rows: number,
  columns: readonly (readonly Value[])[],
  step: (row: number, before: number) => number,
): number[] {
  let [sum, before] = [0, -1];
  return Array.from({ length: rows }, (_, row) => {
    if (columns.every((values) => typeof values[row] === "number")) {
      if (before >= 0) sum += step(row, before);
      before = row;
    }
    return sum;
  });
}

/** The line's value at each of the rising places: between two neighbours, and null beyond the ends and within holes. */
export function onGrid({ x, y }: Line, grid: readonly number[], hole: number): (number | null)[] {
  let i = 0;
  return grid.map((at) => {
    if (x.length === 0 || at < x[0]! || at > x.at(-1)!) return null;
    while (i < x.length - 2 && x[i + 1]! < at) i += 1;
    const next = Math.min(i + 1, x.length - 1);
    const [x0, x1, y0, y1] = [x[i]!, x[next]!, y[i] ?? null, y[next] ?? null];
    if (at === x0 || x1 === x0) return y0;
    if (at === x1) return y1;
    if (y0 === null || y1 === null || x1 - x0 > hole) return null;
    return y0 + ((y1 - y0) * (at - x0)) / (x1 - x0);
  });
}
