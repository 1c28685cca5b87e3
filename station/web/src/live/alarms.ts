// The alarms: the cloud's by the server's answer, and the cars' own by their live values.

import {
  type AlarmEntry,
  type AlarmsAnswer,
  CAR_ALARMS,
  type Config,
  type FieldTable,
} from "../base/contract";
import { number } from "../base/format";
import { act, ask, words } from "../server/answers";
import type { Fleet } from "./fleet";
import { hottest, type Robot } from "./robot";
import { numeric } from "./stream";

// CloudWatch evaluates alarms every minute.
const AGAIN_S = 30;
// A value at a threshold comes and goes.
const HOLD_S = 10;

type CarAlarm = keyof typeof CAR_ALARMS;

/** What a car's live values say, and since when. */
export interface CarState {
  readonly robot: string;
  readonly text: string;
  readonly since: number;
}

/** An alarm that is raised in the cloud, by live values, or by both. */
export interface Raised {
  readonly key: string;
  readonly meaning: string;
  readonly advice: string;
  readonly entry: AlarmEntry | undefined;
  readonly cars: readonly CarState[];
  /** Nobody has seen it since it is raised, or since a car joined. */
  readonly fresh: boolean;
}

export class Alarms {
  /** Undefined before the first answer. */
  entries: readonly AlarmEntry[] | undefined;
  user = "";
  error = "";
  askedAt = NaN;
  private readonly seen = new Map<string, CarState & { readonly alarm: CarAlarm; readonly until: number }>();

  constructor(
    config: Config,
    private readonly fleet: Fleet,
    private readonly table: FieldTable,
  ) {
    if (!config.answers) return;
    void this.load();
    window.setInterval(() => !document.hidden && void this.load(), AGAIN_S * 1000);
    document.addEventListener("visibilitychange", () => !document.hidden && void this.load());
  }

  async load(): Promise<void> {
    try {
      const { alarms, user } = await ask<AlarmsAnswer>("alarms", {});
      [this.entries, this.user, this.error, this.askedAt] = [alarms, user, "", Date.now() / 1000];
    } catch (error) {
      this.error = words(error);
    }
  }

  /** Note that somebody has seen an alarm. */
  async acknowledge({ key, since_s }: AlarmEntry, by: string): Promise<void> {
    try {
      await act("acknowledge", { alarm: key, since_ms: String(Math.round(since_s * 1000)), by });
    } finally {
      await this.load();
    }
  }

  /** The raised alarms: the unseen ones first. */
  raised(now: number): Raised[] {
    const states = this.states(now);
    const known = new Map((this.entries ?? []).map((entry) => [entry.key, entry]));
    const keys = new Set([
      ...(this.entries ?? []).filter(({ state }) => state === "ALARM").map(({ key }) => key),
      ...states.keys(),
    ]);
    const found = [...keys].map((key) => {
      const entry = known.get(key);
      const cars = states.get(key as CarAlarm) ?? [];
      const seen = entry?.state === "ALARM" ? entry.acknowledged : null;
      const { meaning, advice } = entry ?? CAR_ALARMS[key as CarAlarm];
      return {
        key,
        meaning,
        advice,
        entry,
        cars,
        fresh: !seen || cars.some(({ since }) => since > seen.at_s),
      };
    });
    return found.sort((a, b) => Number(b.fresh) - Number(a.fresh));
  }

  private states(now: number): Map<CarAlarm, CarState[]> {
    const found = new Map<CarAlarm, CarState[]>();
    for (const [key, { robot, alarm, text, since, until }] of this.seen) {
      // The state of a car that is gone is unknown.
      const gone = (this.fleet.robots.get(robot)?.freshness(now) ?? "gone") === "gone";
      if (gone || now - until > HOLD_S) this.seen.delete(key);
      else found.set(alarm, [...(found.get(alarm) ?? []), { robot, text, since }]);
    }
    return found;
  }

  /** Look at the cars' newest values. */
  clock(now: number): void {
    for (const robot of this.fleet.robots.values()) {
      if (robot.freshness(now) === "gone") continue;
      for (const [alarm, text] of this.texts(robot)) {
        const key = `${robot.name}/${alarm}`;
        const since = this.seen.get(key)?.since ?? now;
        this.seen.set(key, { robot: robot.name, alarm, text, since, until: now });
      }
    }
  }

  /** The texts have no values, which change with every message. */
  private *texts(robot: Robot): Generator<[CarAlarm, string]> {
    const vesc = robot.vesc(this.table);
    const newest = (field: string): number => numeric(vesc?.sample.get(field));
    const [heat, volts, fault] = [hottest(newest), newest("voltage_input"), robot.fault(this.table)];
    const [hot, low] = [this.threshold("TemperatureDegC"), this.threshold("BatteryVolts")];
    if (fault !== undefined) yield ["FaultSamples", fault];
    if (heat > hot) yield ["TemperatureDegC", `above ${number(hot)} °C`];
    // A driver that has not heard from its VESC says 0 V.
    if (volts > 0 && volts < low) yield ["BatteryVolts", `below ${number(low)} V`];
  }

  /** The deployment's setting; a static site does not know it, and NaN is neither above nor below. */
  private threshold(alarm: CarAlarm): number {
    return this.entries?.find(({ key }) => key === alarm)?.threshold ?? NaN;
  }
}
