// What was stored of a car's streams in a range, by the keys of their fields: `pose/x`, or `speed` of the main stream.

import type { FieldsAnswer, FieldTable, HistoryAnswer, Value } from "../base/contract";
import { asSpeed, numbers, type Spec, spec } from "../base/format";
import { lastAt } from "../base/range";
import type { Columns } from "../charts/lines_panel";
import { claimed, partsOf } from "../live/attachments";
import type { Fleet } from "../live/fleet";

// A line has a gap after this many rows without a value, and at least this long.
const HOLE_ROWS = 2.5;
const LEAST_HOLE_S = 1;
const EARTH_M = 6_371_008.8;
const radians = (degrees: number): number => (degrees * Math.PI) / 180;

type Known = FieldsAnswer["streams"];

/** A field in the units that are shown: its mean, and the minimum and maximum of rows of several samples. */
export interface Field {
  readonly stream: string;
  readonly field: string;
  readonly x: readonly number[];
  readonly columns: Columns;
  readonly spec: Spec;
}

export interface Place {
  readonly t: readonly number[];
  readonly x: number[];
  readonly y: number[];
  readonly degrees: boolean;
}

export class Past {
  constructor(
    private readonly table: FieldTable,
    private readonly fleet: Fleet,
    readonly robot: string,
    readonly main: string,
    /** The fields of the robot's streams, as far as they are known. */
    readonly known: Known,
    readonly drives: ReadonlyMap<string, HistoryAnswer>,
  ) {}

  /** The stream and the field of a key. */
  parse(key: string): readonly [stream: string, field: string] {
    return keyOf(key, this.main);
  }

  key(stream: string, field: string): string {
    return stream === this.main ? field : `${stream}/${field}`;
  }

  spec(key: string): Spec {
    const [stream, field] = this.parse(key);
    const plain = spec(field, this.table, this.drives.get(stream)?.ros2, stream);
    return asSpeed(field, plain, this.fleet.speed(this.robot));
  }

  /** Its label, with the stream's name unless that is the main one. */
  label(key: string): string {
    const [stream] = this.parse(key);
    const { label } = this.spec(key);
    return stream === this.main ? label : `${label}, ${stream}`;
  }

  /** Undefined if there are no numbers of it in the range. */
  field(key: string): Field | undefined {
    const [stream, field] = this.parse(key);
    const drive = this.drives.get(stream);
    if (!drive || !Object.hasOwn(drive.fields, field)) return undefined;
    const { mean, least, most } = drive.fields[field]!;
    if (!mean.some((value) => typeof value === "number")) return undefined;
    const spec = this.spec(key);
    const each = least !== undefined && most !== undefined ? [mean, least, most] : [mean];
    return { stream, field, x: drive.times_s, columns: each.map((values) => numbers(values, spec)), spec };
  }

  /** How long a stream's line goes on without a value, in seconds. */
  hole(stream: string): number {
    return Math.max(LEAST_HOLE_S, (this.drives.get(stream)?.row_s ?? 0) * HOLE_ROWS);
  }

  /** The main stream's fields that are shown as such: the parts of a picture are not, and its speed is in m/s once. */
  shown(stream: string): string[] {
    const drive = this.drives.get(stream);
    if (!drive) return this.known[stream]?.numbers.slice() ?? [];
    const left = new Set(claimed(new Map(Object.entries(drive.fields))).flatMap(partsOf));
    if (this.spec(this.key(stream, "speed")).unit === "m/s" && Object.hasOwn(drive.fields, "speed"))
      left.add("speed_mps");
    return Object.keys(drive.fields).filter((field) => !left.has(field));
  }

  /** The fields with numbers of every stream, as keys. */
  numeric(): ReadonlyMap<string, readonly string[]> {
    const streams = new Set([this.main, ...this.drives.keys(), ...Object.keys(this.known)]);
    return new Map(
      [...streams].map((stream) => {
        const known = this.drives.has(stream) ? this.shown(stream) : (this.known[stream]?.numbers ?? []);
        const keys = known.map((field) => this.key(stream, field));
        return [stream, this.drives.has(stream) ? keys.filter((key) => this.field(key)) : keys] as const;
      }),
    );
  }

  /** Where the robot was, in metres: of degrees, from the first of them. */
  place(stream: string): Place | undefined {
    const drive = this.drives.get(stream);
    const { position: [first = "", second = ""] = [], degrees = false } = this.known[stream] ?? {};
    if (!drive?.fields[first] || !drive.fields[second]) return undefined;
    const [a, b] = [first, second].map((name) =>
      drive.fields[name]!.mean.map((value) => (typeof value === "number" ? value : NaN)),
    ) as [number[], number[]];
    if (!degrees) return { t: drive.times_s, x: a, y: b, degrees };
    // A receiver without a fix says 0, 0.
    const fixed = a.map((value, i) => Math.abs(value) <= 90 && (value !== 0 || b[i] !== 0));
    const from = fixed.findIndex((each, i) => each && !Number.isNaN(b[i]!));
    const [north, east] = [a[from] ?? 0, b[from] ?? 0];
    const along = Math.cos(radians(north)) * EARTH_M;
    return {
      t: drive.times_s,
      x: b.map((value, i) => (fixed[i] ? radians(((value - east + 540) % 360) - 180) * along : NaN)),
      y: a.map((value, i) => (fixed[i] ? radians(value - north) * EARTH_M : NaN)),
      degrees,
    };
  }

  /** A field's values at other times: each the last one before, as long as its line has no gap there. */
  joined(key: string, times: readonly number[]): number[] {
    const field = this.field(key);
    if (!field) return times.map(() => NaN);
    const hole = this.hole(field.stream);
    const same = field.x === times;
    return times.map((at, i) => {
      const row = same ? i : lastAt(field.x, at);
      const away = at - (field.x[row] ?? NaN);
      return away >= -1e-6 && away <= hole ? (field.columns[0]![row] ?? NaN) : NaN;
    });
  }

  value(key: string, row: number): Value {
    const [stream, field] = this.parse(key);
    return this.drives.get(stream)?.fields[field]?.mean[row] ?? null;
  }
}

export const keyOf = (key: string, main: string): readonly [stream: string, field: string] => {
  const [one = "", ...rest] = key.split("/");
  return rest.length === 1 ? [one, rest[0]!] : [main, key];
};
