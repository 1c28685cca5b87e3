// Every car that this page has heard. Names come from the network, so what they fill is bounded.

import type { Linear } from "../base/format";
import { ask, AnswerError } from "../server/answers";
import type { Config, FieldTable, VehiclesAnswer } from "../base/contract";
import { BOUNDS, Robot, Stream } from "./robot";
import type { Arrival } from "./worker_messages";

export class Fleet {
  readonly robots = new Map<string, Robot>();
  received = 0;
  malformed = 0;
  outOfOrder = 0;
  /** What was wrong with the last message refused. */
  lastRefusal = "";
  /** Grows when a car or a stream is heard for the first time, or forgotten. */
  shape = 0;
  private columns = 0;
  private vehicles: VehiclesAnswer["vehicles"];
  private learning: Promise<void> | undefined;

  constructor(
    private readonly config: Config,
    private readonly table: FieldTable,
  ) {
    this.vehicles = config.vehicles;
  }

  /** Take what arrived, and how many messages were refused with it. */
  take(arrivals: readonly Arrival[], refused: number, lastRefusal: string): void {
    this.received += arrivals.length + refused;
    this.malformed += refused;
    if (refused > 0) this.lastRefusal = lastRefusal;
    for (const arrival of arrivals) this.takeOne(arrival);
  }

  private takeOne({ update, at, wall_us, pubnub_us }: Arrival): void {
    const robot = this.robots.get(update.robot) ?? this.meet(update.robot);
    let stream = robot.streams.get(update.stream);
    if (!stream) {
      if (robot.streams.size >= BOUNDS.streams) {
        this.malformed += 1;
        this.lastRefusal = "too many streams";
        return;
      }
      stream = new Stream(update.stream, this.table, () => this.columns < BOUNDS.columns && (this.columns += 1) > 0);
      robot.streams.set(stream.name, stream);
      this.shape += 1;
    }
    if (!stream.take(update, at)) {
      this.outOfOrder += 1;
      return;
    }
    robot.heardAt = at;
    robot.takenAt = Math.max(...[...robot.streams.values()].map((each) => each.takenAt));
    robot.version += 1;
    robot.logFault(stream, this.table, at);
    const { received_ms, lambda_us, offset_us } = update.hops;
    const sent_us = update.hops.sent_us + offset_us;
    const legs = [update.hops.sent_us - update.t_us, received_ms * 1e3 - sent_us, lambda_us - received_ms * 1e3, pubnub_us - lambda_us, wall_us - pubnub_us];
    robot.delays.push([at, (wall_us - sent_us) / 1e3, ...legs.map((leg_us) => leg_us / 1e3)]);
  }

  /** Metres a second of an erpm, which is gain times them and an offset; undefined for a car that is not known. */
  speed(robot: string): Linear | undefined {
    const { speed_to_erpm_gain: gain, speed_to_erpm_offset: offset = 0 } = (Object.hasOwn(this.vehicles, robot) && this.vehicles[robot]) || {};
    return gain ? { scale: 1 / gain, shift: offset === 0 ? 0 : -offset / gain } : undefined;
  }

  /** Ask for the cars' parameters again: one was registered after the page was opened. */
  private async learn(): Promise<void> {
    try {
      this.vehicles = (await ask<VehiclesAnswer>("vehicles", {})).vehicles;
      // What stands on the page was written without.
      for (const robot of this.robots.values()) robot.version += 1;
    } catch (error) {
      // Its speed is shown in erpm, as without a server that answers.
      if (!(error instanceof AnswerError)) throw error;
    }
  }

  private meet(name: string): Robot {
    if (this.robots.size >= BOUNDS.robots) {
      const silent = [...this.robots.values()].reduce((a, b) => (a.heardAt <= b.heardAt ? a : b));
      this.robots.delete(silent.name);
      for (const { columns } of silent.streams.values()) this.columns -= columns.size;
    }
    if (this.config.answers && !Object.hasOwn(this.vehicles, name)) {
      // Twenty cars that come at once are one question.
      this.learning ??= this.learn().finally(() => (this.learning = undefined));
    }
    const robot = new Robot(name);
    this.robots.set(name, robot);
    this.shape += 1;
    return robot;
  }
}
