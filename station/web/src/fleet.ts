// What is known of every car: its streams' newest samples, the last 30 seconds, and the delays.
// Nothing here touches the page; times are the page's own clock, in seconds since it was opened.

import type { Config, FieldTable } from "./config";
import { parseUpdate, type Hops, type Update, type Value } from "./message";
import { Ring } from "./ring";

/** Older values are shown as stale, and a car unheard of for longer as gone. */
export const STALE_S = 1.5;
export const GONE_S = 5;
/** What the charts show, and what a median is taken over. */
export const WINDOW_S = 30;
export const MEDIAN_S = 10;

/** The fields that have charts of their own; their columns in a stream's history follow the time. */
export const CHARTED = ["speed", "voltage_input", "current_motor", "current_input", "duty_cycle"] as const;

// Room for 30 s at 30 Hz; the live lane carries at most 10.
const KEPT = 1024;
// Names come from the network, so their number is bounded.
const MAX_ROBOTS = 256;
const MAX_STREAMS = 32;
const KEPT_BOOTS = 8;

export type Freshness = "live" | "stale" | "gone";

export interface Delay {
  total: number;
  toCloud: number;
  toLambda: number;
  toPage: number;
}

/**
 * Where the sample times of a car's clock lie on the page's clock: the smallest difference seen within
 * the last half to whole minute, which is that of the message that travelled fastest.
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
  hops: Hops = { sent_us: 0, received_ms: 0, lambda_us: 0 };
  sample: ReadonlyMap<string, Value> = new Map();
  /** When the newest sample was taken, on the page's clock, if it had come as fast as the fastest. */
  takenAt = -Infinity;
  heardAt = -Infinity;
  received = 0;
  /** Grows with every sample that becomes the newest. */
  version = 0;
  readonly history = new Ring(1 + CHARTED.length, KEPT);
  private readonly arrivals = new Ring(1, KEPT);
  private readonly offset = new ClockOffset();
  private readonly oldBoots: string[] = [];

  constructor(readonly name: string) {}

  /** Take a newer sample; false for one that comes after a newer one, or twice. */
  take(update: Update, now: number): boolean {
    if (update.boot === this.boot) {
      if (update.seq <= this.seq) return false;
      // The car's clock was set back.
      if (update.t_us < this.t_us) this.offset.reset();
    } else {
      if (this.oldBoots.includes(update.boot)) return false;
      if (this.boot !== "") this.oldBoots.push(this.boot);
      if (this.oldBoots.length > KEPT_BOOTS) this.oldBoots.shift();
      this.offset.reset();
    }
    ({ boot: this.boot, seq: this.seq, t_us: this.t_us, hops: this.hops, sample: this.sample } = update);
    const t = update.t_us / 1e6;
    this.takenAt = Math.min(now, t + this.offset.take(now - t, now));
    this.heardAt = now;
    this.received += 1;
    this.version += 1;
    this.arrivals.push(now);
    if (!(this.takenAt <= this.history.last(0))) {
      this.history.push(this.takenAt, ...CHARTED.map((field) => numeric(update.sample.get(field))));
    }
    return true;
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
  /** Arrival, and in milliseconds: car to page, car to cloud, cloud to Lambda, Lambda to page. */
  readonly delays = new Ring(5, KEPT);
  heardAt = -Infinity;
  takenAt = -Infinity;
  version = 0;

  constructor(readonly name: string) {}

  freshness(now: number): Freshness {
    if (now - this.heardAt > GONE_S) return "gone";
    return now - this.takenAt > STALE_S ? "stale" : "live";
  }

  /** The stream whose fields are the motor controller's, if there is one. */
  vesc(table: FieldTable): Stream | undefined {
    const named = this.streams.get(table.stream);
    if (named) return named;
    for (const stream of this.streams.values()) {
      if (stream.sample.has("voltage_input") && stream.sample.has("duty_cycle")) return stream;
    }
    return undefined;
  }

  /** The name of the fault that a stream reports, if any does. */
  fault(table: FieldTable): string | undefined {
    for (const { sample } of this.streams.values()) {
      const code = sample.get("fault_code");
      if (typeof code === "number" && code !== 0) return `${table.faults[String(code)] ?? "unknown fault"} (${code})`;
    }
    return undefined;
  }

  newestDelay(): Delay | undefined {
    if (this.delays.length === 0) return undefined;
    const [total, toCloud, toLambda, toPage] = [1, 2, 3, 4].map((i) => this.delays.last(i)) as [number, number, number, number];
    return { total, toCloud, toLambda, toPage };
  }

  medianDelay(now: number): Delay | undefined {
    const times = this.delays.column(0, now - MEDIAN_S);
    const skip = times.length > 0 && times[0]! < now - MEDIAN_S ? 1 : 0;
    if (times.length - skip === 0) return undefined;
    const [total, toCloud, toLambda, toPage] = [1, 2, 3, 4].map((i) =>
      median(this.delays.column(i, now - MEDIAN_S).subarray(skip)),
    ) as [number, number, number, number];
    return { total, toCloud, toLambda, toPage };
  }
}

export class Fleet {
  readonly robots = new Map<string, Robot>();
  received = 0;
  malformed = 0;
  outOfOrder = 0;
  /** What was wrong with the last message refused. */
  lastRefusal = "";
  /** Grows when a car or a stream is heard for the first time, or forgotten. */
  shape = 0;

  constructor(
    private readonly config: Config,
    private readonly table: FieldTable,
  ) {}

  /** Take a message that arrived now; never throws. `wall_us` is the time of day, `now` the page's. */
  take(channel: string, message: unknown, wall_us: number, now: number): void {
    this.received += 1;
    const update = parseUpdate(this.config.namespace, this.table.version, channel, message);
    if (typeof update === "string") {
      this.malformed += 1;
      this.lastRefusal = update;
      return;
    }
    const robot = this.robots.get(update.robot) ?? this.meet(update.robot);
    let stream = robot.streams.get(update.stream);
    if (!stream) {
      if (robot.streams.size >= MAX_STREAMS) {
        this.malformed += 1;
        this.lastRefusal = "too many streams";
        return;
      }
      stream = new Stream(update.stream);
      robot.streams.set(stream.name, stream);
      this.shape += 1;
    }
    if (!stream.take(update, now)) {
      this.outOfOrder += 1;
      return;
    }
    robot.heardAt = now;
    robot.takenAt = Math.max(...[...robot.streams.values()].map((each) => each.takenAt));
    robot.version += 1;
    const { sent_us, received_ms, lambda_us } = update.hops;
    robot.delays.push(
      now,
      (wall_us - sent_us) / 1e3,
      received_ms - sent_us / 1e3,
      lambda_us / 1e3 - received_ms,
      (wall_us - lambda_us) / 1e3,
    );
  }

  /** Metres a second for an erpm, where the car's parameters are known. */
  gain(robot: string): number | undefined {
    return Object.hasOwn(this.config.vehicles, robot) ? this.config.vehicles[robot]?.speed_to_erpm_gain : undefined;
  }

  private meet(name: string): Robot {
    if (this.robots.size >= MAX_ROBOTS) {
      const silent = [...this.robots.values()].reduce((a, b) => (a.heardAt <= b.heardAt ? a : b));
      this.robots.delete(silent.name);
    }
    const robot = new Robot(name);
    this.robots.set(name, robot);
    this.shape += 1;
    return robot;
  }
}

export function numeric(value: Value | undefined): number {
  return typeof value === "number" ? value : NaN;
}

function median(values: Float64Array): number {
  const sorted = values.slice().sort();
  const middle = sorted.length >> 1;
  return sorted.length % 2 === 1 ? sorted[middle]! : (sorted[middle - 1]! + sorted[middle]!) / 2;
}
