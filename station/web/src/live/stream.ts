// One stream of a car: the newest sample, and the values of the last seconds. A watched car's go back further.

import type { FieldTable, Value } from "../base/contract";
import type { Hops, Update } from "../link/update";
import { type Claim, claim, claimed } from "./attachments";
import { BOUNDS, DEEP_S, deepRows, WINDOW_S } from "./bounds";
import { Ring } from "./ring";

/** The field that the fleet's cards draw; it is kept when the columns of all cars are used up. */
export const CARD_FIELD = "speed";

// The time over which a rate is measured.
const RATE_S = 2;

/** The columns of all cars together. */
export interface Used {
  columns: number;
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
  hops: Hops = {
    sent_us: 0,
    received_ms: undefined,
    lambda_us: undefined,
    offset_us: 0,
    offset_known: false,
  };
  sample: ReadonlyMap<string, Value> = new Map();
  /** The newest sample's time on the page's clock, as if it were as fast as the fastest message. */
  takenAt = -Infinity;
  heardAt = -Infinity;
  /** How long the stream may be silent after its newest sample, by what that says. */
  silent_s = 0;
  received = 0;
  /** Grows with every newer sample. */
  version = 0;
  /** Column 0 is `takenAt`; a numeric field's column is in `columns`. */
  history = new Ring(1, BOUNDS.rows, WINDOW_S);
  readonly columns = new Map<string, number>();
  /** Whether charge and energy have the ROS 2 driver's units: counts of 1e-4 Ah are whole. */
  ros2 = false;
  /** For each field of bytes its newest attachment; not every sample has one. */
  readonly claims = new Map<string, { readonly claim: Claim; readonly takenAt: number }>();
  private readonly arrivals = new Ring(1, BOUNDS.rows, RATE_S);
  private readonly offset = new ClockOffset();
  private readonly oldBoots: string[] = [];
  private readonly row: number[] = [];

  constructor(
    readonly name: string,
    private readonly table: FieldTable,
    private readonly used: Used,
    private watched: boolean,
  ) {}

  /** Keep the values of the longest window while the car is watched, and else those of the shortest. */
  watch(watched: boolean): void {
    this.watched = watched;
    if (!watched && this.used.columns > BOUNDS.columns) this.forget();
    this.bound();
  }

  /** Forget the values but the newest; the next sample begins anew. */
  forget(): void {
    this.used.columns -= this.columns.size;
    this.columns.clear();
    this.history = new Ring(1, BOUNDS.rows, WINDOW_S);
    this.version += 1;
  }

  /** Add values of the past; times are on the page's clock. */
  prefill(times: readonly number[], fields: ReadonlyMap<string, ArrayLike<number>>): void {
    const columns = new Map<number, ArrayLike<number>>();
    for (const [field, values] of fields) {
      const column = this.column(field);
      if (column !== undefined) columns.set(column, values);
    }
    this.bound();
    this.history.insert(times, columns);
    this.version += 1;
  }

  private bound(): void {
    if (this.watched) this.history.keep(DEEP_S, deepRows(this.history.width));
    else this.history.keep(WINDOW_S, BOUNDS.rows);
  }

  /** The field's column, a new one if there may be one. */
  private column(field: string): number | undefined {
    const known = this.columns.get(field);
    if (known !== undefined) return known;
    const most = BOUNDS.columns + (this.watched ? BOUNDS.watched : 0);
    const onCard = field === CARD_FIELD && this.name === this.table.stream;
    if (this.used.columns >= most && !onCard) return undefined;
    this.used.columns += 1;
    const column = this.history.widen();
    this.columns.set(field, column);
    return column;
  }

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
    this.silent_s = update.next_ms / 1000;
    this.received += 1;
    this.version += 1;
    this.arrivals.push([now]);
    for (const [field, value] of update.sample) {
      if (
        typeof value === "number" &&
        !Number.isInteger(value) &&
        this.table.fields[field]?.ros2_unit !== undefined
      )
        this.ros2 = true;
    }
    if (!(this.takenAt <= this.history.last(0))) this.keep(update.sample);
    for (const field of claimed(update.sample).slice(0, BOUNDS.claims)) {
      const kept = claim(field, (name) => update.sample.get(name));
      if (kept && (this.claims.has(field) || this.claims.size < BOUNDS.claims))
        this.claims.set(field, { claim: kept, takenAt: this.takenAt });
    }
    return true;
  }

  private keep(sample: ReadonlyMap<string, Value>): void {
    const { row } = this;
    row.fill(NaN);
    row[0] = this.takenAt;
    for (const [field, value] of sample) {
      if (typeof value !== "number") continue;
      const column = this.column(field);
      if (column !== undefined) row[column] = value;
    }
    this.bound();
    this.history.push(row);
  }

  /** Messages a second. */
  rate(now: number): number {
    const times = this.arrivals.column(0, now - RATE_S);
    let n = 0;
    for (const time of times) if (time > now - RATE_S) n += 1;
    return n / RATE_S;
  }
}

export function numeric(value: Value | undefined): number {
  return typeof value === "number" ? value : NaN;
}
