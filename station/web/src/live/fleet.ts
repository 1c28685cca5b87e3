// Every car that this page has heard. Names come from the network, so the number of cars is bounded.

import type { Config, FieldTable, VehiclesAnswer } from "../base/contract";
import type { Linear } from "../base/format";
import type { Arrival, Refused } from "../link/worker_messages";
import { AnswerError, ask } from "../server/answers";
import { BOUNDS } from "./bounds";
import { Robot } from "./robot";
import { Stream, type Used } from "./stream";

export class Fleet {
  readonly robots = new Map<string, Robot>();
  received = 0;
  malformed = 0;
  outOfOrder = 0;
  /** The reason of the last rejected message. */
  lastRefusal = "";
  /** Grows when a car or a stream is new or forgotten. */
  shape = 0;
  /** The rejected messages of each robot, also of one that has sent nothing else. */
  readonly refused = new Map<string, Refused>();
  private readonly used: Used = { columns: 0 };
  private watched: Robot | undefined;
  private vehicles: VehiclesAnswer["vehicles"];
  private learning: Promise<void> | undefined;

  constructor(
    private readonly config: Config,
    private readonly table: FieldTable,
  ) {
    this.vehicles = config.vehicles;
  }

  /** Take arrivals, and the messages rejected meanwhile. */
  take(arrivals: readonly Arrival[], refused: readonly Refused[]): void {
    this.received += arrivals.length;
    for (const each of refused) {
      this.received += each.messages;
      this.refuse(each);
    }
    for (const arrival of arrivals) this.takeOne(arrival);
  }

  private takeOne({ update, at, wall_us, pubnub_us }: Arrival): void {
    const robot = this.robots.get(update.robot) ?? this.meet(update.robot);
    let stream = robot.streams.get(update.stream);
    if (!stream) {
      if (robot.streams.size >= BOUNDS.streams) {
        this.refuse({ robot: robot.name, messages: 1, reason: "too many streams" });
        return;
      }
      stream = new Stream(update.stream, this.table, this.used, robot === this.watched);
      robot.streams.set(stream.name, stream);
      this.shape += 1;
    }
    if (!stream.take(update, at)) {
      this.outOfOrder += 1;
      return;
    }
    robot.heard(at);
    robot.logFault(stream, this.table, at);
    robot.logLine(stream);
    const { received_ms = NaN, lambda_us = NaN, offset_us } = update.hops;
    const sent_us = update.hops.sent_us + offset_us;
    // A message that came straight from the broker has one leg from the car to here.
    const last_us = wall_us - (pubnub_us ?? sent_us);
    const legs = [
      update.hops.sent_us - update.t_us,
      received_ms * 1e3 - sent_us,
      lambda_us - received_ms * 1e3,
      (pubnub_us ?? NaN) - lambda_us,
      last_us,
    ];
    robot.delays.push([at, (wall_us - sent_us) / 1e3, ...legs.map((leg_us) => leg_us / 1e3)]);
  }

  private refuse({ robot, messages, reason }: Refused): void {
    this.malformed += messages;
    this.lastRefusal = robot ? `${robot}: ${reason}` : reason;
    if (robot && (this.refused.has(robot) || this.refused.size < BOUNDS.robots)) {
      this.refused.set(robot, {
        robot,
        messages: (this.refused.get(robot)?.messages ?? 0) + messages,
        reason,
      });
    }
  }

  /** The conversion from erpm to m/s; undefined if the car's parameters are unknown. */
  speed(robot: string): Linear | undefined {
    const { speed_to_erpm_gain: gain, speed_to_erpm_offset: offset = 0 } =
      (Object.hasOwn(this.vehicles, robot) && this.vehicles[robot]) || {};
    return gain ? { scale: 1 / gain, shift: offset === 0 ? 0 : -offset / gain } : undefined;
  }

  /** Keep the values of a car's longest window, instead of another's. */
  watch(robot: Robot | undefined): void {
    if (robot === this.watched) return;
    this.watched?.watch(false);
    this.watched = robot;
    robot?.watch(true);
  }

  /** Ask for the cars' parameters again: a car was registered after the page was opened. */
  private async learn(): Promise<void> {
    try {
      this.vehicles = (await ask<VehiclesAnswer>("vehicles", {})).vehicles;
      // The page shows values without the new parameters.
      for (const robot of this.robots.values()) robot.version += 1;
    } catch (error) {
      // The speed stays in erpm, as without a server.
      if (!(error instanceof AnswerError)) throw error;
    }
  }

  private meet(name: string): Robot {
    if (this.robots.size >= BOUNDS.robots) {
      const silent = [...this.robots.values()].reduce((a, b) => (a.heardAt <= b.heardAt ? a : b));
      this.robots.delete(silent.name);
      for (const stream of silent.streams.values()) stream.forget();
    }
    if (this.config.answers && !Object.hasOwn(this.vehicles, name)) {
      // Several new cars at once are one request.
      this.learning ??= this.learn().finally(() => (this.learning = undefined));
    }
    const robot = new Robot(name);
    this.robots.set(name, robot);
    this.shape += 1;
    return robot;
  }
}
