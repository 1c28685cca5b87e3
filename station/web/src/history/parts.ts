// Loads the parts of a comparison, and puts them on one grid.

import type { FieldTable, HistoryAnswer } from "../base/contract";
import { asSpeed, numbers, type Spec, spec } from "../base/format";
import { inUs, type Range } from "../base/range";
import type { Part } from "../base/route";
import type { Columns } from "../charts/lines_panel";
import type { Fleet } from "../live/fleet";
import { ask } from "../server/answers";
import { type Axis, distance, onGrid } from "./align";

// The rows of a request, and the steps of the grid: about the width of a chart in points.
const ROWS = 1500;
const UNITS = { time: "s", distance: "m" } as const;
const HOLES = 2.5;
const LEAST_HOLE_S = 1;
const MOST_KEPT = 24;

interface Loaded {
  readonly part: Part;
  readonly drive: HistoryAnswer;
  /** The seconds since the part's start, and the place on the axis. */
  readonly t: readonly number[];
  readonly x: readonly number[];
}

/** What is charted, in the units that are shown: for each field a column for each name, over x in the unit `along`. A
 *  line has a gap after `hole` of x without a value. */
export interface Charted {
  readonly x: readonly number[];
  readonly along: string;
  readonly hole: number;
  readonly fields: ReadonlyMap<string, Columns>;
  readonly names: readonly string[];
}

/** The parts' values on a common grid, in the range that is zoomed to; the whole range; and how many samples there are. */
interface Compared extends Omit<Charted, "names"> {
  readonly extent: Range;
  readonly samples: number;
  readonly archived: boolean;
}

/** Raised for parts that have no distance. */
export class NoDistance extends Error {}

export class Parts {
  /** Whole parts, by robot, stream and range. */
  private readonly whole = new Map<string, Promise<HistoryAnswer>>();

  constructor(
    private readonly table: FieldTable,
    private readonly fleet: Fleet,
  ) {}

  /** Throws `NoDistance`. */
  async load(
    parts: readonly Part[],
    stream: string,
    axis: Axis,
    zoom: Range | undefined,
    signal: AbortSignal,
  ): Promise<Compared> {
    const wholes = await Promise.all(
      parts.map(async (part) => this.placed(part, await this.read(part, stream), axis)),
    );
    const extent: Range = [0, Math.max(1e-3, ...wholes.map(({ x }) => x.at(-1) ?? 0))];
    const range = zoom ?? extent;
    const shown = zoom
      ? await Promise.all(wholes.map((whole) => this.within(whole, stream, axis, zoom, signal)))
      : wholes;
    const step = (range[1] - range[0]) / ROWS;
    const grid = Array.from({ length: ROWS + 1 }, (_, i) => range[0] + i * step);
    const samples = wholes.reduce((sum, { drive }) => sum + drive.samples, 0);
    const archived = wholes.some(({ drive }) => drive.archive !== null);
    const fields = this.fields(shown, stream, grid, axis);
    return { samples, archived, extent, x: grid, along: UNITS[axis], hole: Infinity, fields };
  }

  /** The format of a field: the speed of the cars, if it is known of all of them. */
  spec(field: string, stream: string, parts: readonly Part[]): Spec {
    const speeds = parts.map(({ robot }) => this.fleet.speed(robot));
    const all = speeds.every((speed) => speed !== undefined);
    return asSpeed(field, spec(field, this.table, false, stream), all ? speeds[0] : undefined);
  }

  private read(part: Part, stream: string): Promise<HistoryAnswer> {
    const key = [part.robot, stream, ...part.range].join("/");
    let answer = this.whole.get(key);
    if (!answer) {
      if (this.whole.size >= MOST_KEPT) this.whole.clear();
      answer = asked(part.robot, stream, part.range);
      this.whole.set(key, answer);
      answer.catch(() => this.whole.delete(key));
    }
    return answer;
  }

  private placed(part: Part, drive: HistoryAnswer, axis: Axis): Loaded {
    const t = drive.times_s.map((at) => at - part.range[0]);
    if (axis === "time" || t.length === 0) return { part, drive, t, x: t };
    const x = distance(drive, this.fleet.speed(part.robot));
    if (!x) throw new NoDistance(part.robot);
    return { part, drive, t, x };
  }

  /** Finer data of what a part has in a range of x. */
  private async within(
    { part, t, x, drive }: Loaded,
    stream: string,
    axis: Axis,
    zoom: Range,
    signal: AbortSignal,
  ): Promise<Loaded> {
    const first = x.findIndex((at) => at >= zoom[0]);
    const last = x.findLastIndex((at) => at <= zoom[1]);
    // A row more at each end, so that the lines reach the edges.
    const [from, to] = [t[Math.max(0, first - 1)], t[Math.min(t.length - 1, last + 1)]];
    if (first < 0 || last < 0 || from === undefined || to === undefined || drive.row_s === 0)
      return { part, drive, t, x };
    const range: Range = [part.range[0] + from, part.range[0] + to + drive.row_s];
    const finer = await asked(part.robot, stream, range, signal);
    const there = this.placed(part, finer, axis);
    if (axis === "time") return there;
    const offset = onGrid({ x: t, y: x }, [there.t[0] ?? 0], Infinity)[0] ?? 0;
    return { ...there, x: there.x.map((at) => at + offset) };
  }

  private fields(
    shown: readonly Loaded[],
    stream: string,
    grid: readonly number[],
    axis: Axis,
  ): Charted["fields"] {
    const parts = shown.map(({ part }) => part);
    const numeric = ({ drive }: Loaded): string[] =>
      Object.keys(drive.fields).filter((field) =>
        drive.fields[field]!.mean.some((value) => typeof value === "number"),
      );
    const names = new Set(shown.flatMap(numeric));
    // The speed of the cars is shown as the field speed.
    const all = this.spec("speed", stream, parts).unit === "m/s";
    if (names.has("speed") && all) names.delete("speed_mps");
    const column = (field: string, { part, drive, x }: Loaded): (number | null)[] => {
      const speed = all ? this.fleet.speed(part.robot) : undefined;
      const as = asSpeed(field, spec(field, this.table, drive.ros2, stream), speed);
      const y = numbers(drive.fields[field]?.mean ?? [], as);
      if (y.length === 0) return grid.map(() => null);
      const hole = axis === "time" ? Math.max(LEAST_HOLE_S, drive.row_s * HOLES) : Infinity;
      return onGrid({ x, y }, grid, hole);
    };
    return new Map([...names].map((field) => [field, shown.map((each) => column(field, each))]));
  }
}

const asked = (robot: string, stream: string, range: Range, signal?: AbortSignal): Promise<HistoryAnswer> =>
  ask<HistoryAnswer>("history", { robot, stream, ...inUs(range), rows: String(ROWS) }, signal);
