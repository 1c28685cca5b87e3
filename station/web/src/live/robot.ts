// One car: the newest sample of each stream, the last 30 seconds, the delays and the faults. Nothing here
// touches the page; times are those of base/clock.ts.

import { GONE_S, STALE_S, type FieldTable, type Value } from "../base/contract";
import { claim, claimed, type Claim } from "./attachments";
import { Ring } from "./ring";
import type { Hops, Update } from "./update";

/** The range of the charts, and of medians. */
export const WINDOW_S = 30;
export const MEDIAN_S = 10;

// Names and fields come from the network, so everything that they fill is bounded: 30 s at 16 Hz (the live lane
// carries at most 10), and 12 MB of columns in all.
export const BOUNDS = { rows: 512, delays: 2048, columns: 1536, robots: 256, streams: 32, boots: 8, faults: 100, claims: 4 } as const;

export type Freshness = "live" | "stale" | "gone";

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

/**
 * The offset from a car's clock to the page's clock: the smallest difference of the last 30 to 60 s, which is that of
 * the fastest message.
 */
class ClockOffset {
  private current = Infinity;
  private previous = Infinity;
  private since = 0;

  reset(): void {
    this.current = this.previous = Infinity;
  }

  take(difference: number, now: number): number {
    if (now - this.since > 30) {
      [this.previous, this.current, this.since] = [this.current, Infinity, now];
    }
    this.current = Math.min(this.current, difference);
    return Math.min(this.current, this.previous);
  }
}

export class Stream {
  boot = "";
  seq = -1;
  t_us = 0;
  hops: Hops = { sent_us: 0, received_ms: 0, lambda_us: 0, offset_us: 0, offset_known: false };
  sample: ReadonlyMap<string, Value> = new Map();
  /** The newest sample's time on the page's clock, as if it were as fast as the fastest message. */
  takenAt = -Infinity;
  heardAt = -Infinity;
  received = 0;
  /** Grows with every newer sample. */
  version = 0;
  /** Column 0 is `takenAt`; a numeric field's column is in `columns`. */
  readonly history = new Ring(1, BOUNDS.rows);
  readonly columns = new Map<string, number>();
  /** Whether charge and energy have the ROS 2 driver's units: counts of 1e-4 Ah are whole. */
  ros2 = false;
  /** For each field of bytes its newest attachment; not every sample has one. */
  readonly claims = new Map<string, { readonly claim: Claim; readonly takenAt: number }>();
  private readonly arrivals = new Ring(1, BOUNDS.rows);
  private readonly offset = new ClockOffset();
  private readonly oldBoots: string[] = [];
  private readonly row: number[] = [];

  constructor(
    readonly name: string,
    private readonly table: FieldTable,
    private readonly mayWiden: () => boolean,
  ) {}

  /** Take a newer sample; false for an older or repeated one. */
  take(update: Update, now: number): boolean {
    if (update.boot === this.boot) {
      if (update.seq <= this.seq) return false;
      // The car's clock was set back.
      if (update.t_us < this.t_us) this.offset.reset();
    } else {
      if (this.oldBoots.includes(update.boot)) return false;
      if (this.boot !== "") this.oldBoots.push(this.boot);
      if (this.oldBoots.length > BOUNDS.boots) this.oldBoots.shift();
      this.offset.reset();
      this.ros2 = false;
    }
    ({ boot: this.boot, seq: this.seq, t_us: this.t_us, hops: this.hops, sample: this.sample } = update);
    const t = update.t_us / 1e6;
    this.takenAt = Math.min(now, t + this.offset.take(now - t, now));
    this.heardAt = now;
    this.received += 1;
    this.version += 1;
    this.arrivals.push([now]);
    for (const [field, value] of update.sample) {
      if (typeof value === "number" && !Number.isInteger(value) && this.table.fields[field]?.ros2_unit !== undefined) this.ros2 = true;
    }
    if (!(this.takenAt <= this.history.last(0))) this.keep(update.sample);
    for (const field of claimed(update.sample).slice(0, BOUNDS.claims)) {
      const kept = claim(field, (name) => update.sample.get(name));
      if (kept && (this.claims.has(field) || this.claims.size < BOUNDS.claims)) this.claims.set(field, { claim: kept, takenAt: this.takenAt });
    }
    return true;
  }

  private keep(sample: ReadonlyMap<string, Value>): void {
    const { row } = this;
    row.fill(NaN);
    row[0] = this.takenAt;
    for (const [field, value] of sample) {
      if (typeof value !== "number") continue;
      let column = this.columns.get(field);
      if (column === undefined) {
        if (!this.mayWiden()) continue;
        column = this.history.widen();
        this.columns.set(field, column);
      }
      row[column] = value;
    }
    this.history.push(row);
  }

  /** Messages a second over the last two seconds. */
  rate(now: number): number {
    const times = this.arrivals.column(0, now - 2);
    let n = 0;
    for (const time of times) if (time > now - 2) n += 1;
    return n / 2;
  }
}

export class Robot {
  readonly streams = new Map<string, Stream>();
  /** Arrival in seconds; the total and the hops in milliseconds. */
  readonly delays = new Ring(2 + LEGS.length, BOUNDS.delays);
  /** The newest last. */
  readonly faults: Fault[] = [];
  heardAt = -Infinity;
  takenAt = -Infinity;
  version = 0;

  constructor(readonly name: string) {}

  freshness(now: number): Freshness {
    if (now - this.heardAt > GONE_S) return "gone";
    return now - this.takenAt > STALE_S ? "stale" : "live";
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

export function numeric(value: Value | undefined): number {
  return typeof value === "number" ? value : NaN;
}

export function median(values: Float64Array): number {
  const sorted = values.slice().sort();
  const middle = sorted.length >> 1;
  return sorted.length % 2 === 1 ? sorted[middle]! : (sorted[middle - 1]! + sorted[middle]!) / 2;
}
