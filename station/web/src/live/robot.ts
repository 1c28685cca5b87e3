// One car: its streams, the delays and the faults. Nothing here touches the page; times are those of base/clock.ts.

import {
  DRIVE_STREAM,
  type FieldTable,
  GONE_S,
  LOG_STREAM,
  STALE_S,
  TEMPERATURES,
  type Value,
} from "../base/contract";
import { BOUNDS, DEEP_S, deepRows, MEDIAN_S, WINDOW_S } from "./bounds";
import { type Line, lineOf } from "./lines";
import { Ring } from "./ring";
import type { Stream } from "./stream";

/** An idle car's values are as new as it said that they would be: it sends less while nobody looks. */
export type Freshness = "live" | "idle" | "stale" | "gone";

/** A message's hops, in the order of the columns of `Robot.delays` after arrival and total. */
export const LEGS = ["car", "toCloud", "toLambda", "toPubNub", "toPage"] as const;
export type Leg = (typeof LEGS)[number];
/** In milliseconds. The total is from leaving the car to arriving here, without the hop within the car. */
export type Delay = { readonly total: number } & Readonly<Record<Leg, number>>;

export interface Fault {
  /** The first and last report, in seconds since the epoch. */
  readonly since: number;
  until: number;
  readonly name: string;
  readonly stream: string;
  over: boolean;
}

export class Robot {
  readonly streams = new Map<string, Stream>();
  /** Arrival in seconds; the total and the hops in milliseconds. */
  readonly delays = new Ring(2 + LEGS.length, BOUNDS.delays, WINDOW_S);
  /** The newest last. */
  readonly faults: Fault[] = [];
  /** The agent's warnings and errors, the newest last. */
  readonly lines: Line[] = [];
  heardAt = -Infinity;
  takenAt = -Infinity;
  /** Until then the car may be silent, and its newest values old. */
  private silentUntil = -Infinity;
  private freshUntil = -Infinity;
  version = 0;

  constructor(readonly name: string) {}

  /** Keep the values of the longest window while the car is watched, and else those of the shortest. */
  watch(watched: boolean): void {
    if (watched) this.delays.keep(DEEP_S, deepRows(this.delays.width));
    else this.delays.keep(WINDOW_S, BOUNDS.delays);
    for (const stream of this.streams.values()) stream.watch(watched);
  }

  /** Note that a stream has a newer sample. */
  heard(at: number): void {
    const streams = [...this.streams.values()];
    this.heardAt = at;
    this.takenAt = Math.max(...streams.map((each) => each.takenAt));
    this.silentUntil = Math.max(...streams.map((each) => each.heardAt + each.silent_s));
    this.freshUntil = Math.max(...streams.map((each) => each.takenAt + each.silent_s));
    this.version += 1;
  }

  /** For how long the car has been silent, beyond what it said. */
  overdue_s(now: number): number {
    return now - this.silentUntil;
  }

  freshness(now: number): Freshness {
    if (this.overdue_s(now) > GONE_S) return "gone";
    if (now - this.freshUntil > STALE_S) return "stale";
    return now - this.takenAt > STALE_S ? "idle" : "live";
  }

  /** The stream of the motor controller, if the car has one. */
  vesc(table: FieldTable): Stream | undefined {
    const named = this.streams.get(table.stream);
    if (named) return named;
    for (const stream of this.streams.values()) {
      if (stream.sample.has("voltage_input") && stream.sample.has("duty_cycle")) return stream;
    }
    return undefined;
  }

  /** The name of a reported fault, if any. */
  fault(table: FieldTable): string | undefined {
    for (const { sample } of this.streams.values()) {
      const name = faultName(sample.get("fault_code"), table);
      if (name !== undefined) return name;
    }
    return undefined;
  }

  /** Who drives the car by hand, as it says. */
  driver(now: number): string | undefined {
    const stream = this.streams.get(DRIVE_STREAM);
    const left_ms = stream?.sample.get("lease_left_ms");
    if (!stream?.sample.get("driver") || typeof left_ms !== "number" || now > stream.heardAt + left_ms / 1000)
      return undefined;
    const by = stream.sample.get("driver_by");
    return typeof by === "string" ? by : "somebody";
  }

  newestDelay(): Delay | undefined {
    return this.delays.length === 0 ? undefined : asDelay((column) => this.delays.last(column));
  }

  medianDelay(now: number): Delay | undefined {
    const from = now - MEDIAN_S;
    const times = this.delays.column(0, from);
    const skip = times.length > 0 && times[0]! < from ? 1 : 0;
    if (times.length - skip === 0) return undefined;
    return asDelay((column) => median(this.delays.column(column, from).subarray(skip)));
  }

  /** Keep the newest line of the agent's log. */
  logLine(stream: Stream): void {
    const line =
      stream.name === LOG_STREAM ? lineOf(stream.t_us, (name) => stream.sample.get(name)) : undefined;
    if (!line) return;
    this.lines.push(line);
    if (this.lines.length > BOUNDS.lines) this.lines.shift();
  }

  /** Update the fault log: an entry is from the first to the last sample that reports it. */
  logFault(stream: Stream, table: FieldTable, at: number): void {
    const code = stream.sample.get("fault_code");
    if (code === undefined) return;
    const name = faultName(code, table);
    const open = this.faults.findLast((fault) => fault.stream === stream.name && !fault.over);
    if (open && open.name === name) open.until = at;
    else {
      if (open) open.over = true;
      if (name === undefined) return;
      this.faults.push({ since: at, until: at, name, stream: stream.name, over: false });
      if (this.faults.length > BOUNDS.faults) this.faults.shift();
    }
  }
}

function faultName(code: Value | undefined, table: FieldTable): string | undefined {
  if (typeof code !== "number" || code === 0) return undefined;
  return `${table.faults[String(code)] ?? "unknown fault"} (${code})`;
}

function asDelay(column: (index: number) => number): Delay {
  const legs = Object.fromEntries(LEGS.map((leg, i) => [leg, column(2 + i)])) as Record<Leg, number>;
  return { total: column(1), ...legs };
}

export function median(values: Float64Array): number {
  const sorted = values.slice().sort();
  const middle = sorted.length >> 1;
  return sorted.length % 2 === 1 ? sorted[middle]! : (sorted[middle - 1]! + sorted[middle]!) / 2;
}

/** The controller's hottest temperature, as in the contract: a sensor that is not read is 0. */
export const hottest = (newest: (field: string) => number): number => {
  const known = TEMPERATURES.map(newest).filter((value) => !Number.isNaN(value) && value !== 0);
  return known.length > 0 ? Math.max(...known) : NaN;
};
