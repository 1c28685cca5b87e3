// The page's state for tests and for the browser's console; every access makes a copy, so it is read-only.

import { now } from "../base/clock";
import { GONE_S, STALE_S } from "../base/contract";
import { BOUNDS } from "./bounds";
import type { Feed } from "./feed";
import type { Fleet } from "./fleet";

export function observer(fleet: Fleet, feed: Feed, tick_s: number): object {
  const robots = (): object =>
    Object.fromEntries(
      [...fleet.robots.values()].map((robot) => {
        const at = now();
        const streams = [...robot.streams.values()].map((stream) => {
          const { name, boot, seq, t_us, hops, sample, received, takenAt, history } = stream;
          const kept = { rows: history.length, columns: history.width };
          return [
            name,
            {
              boot,
              seq,
              t: t_us,
              hops: { ...hops },
              sample: Object.fromEntries(sample),
              received,
              age_s: at - takenAt,
              kept,
            },
          ];
        });
        const delay_ms = { newest: robot.newestDelay(), median: robot.medianDelay(at) };
        const silent_s = at - robot.heardAt;
        return [
          robot.name,
          {
            state: robot.freshness(at),
            silent_s,
            streams: Object.fromEntries(streams),
            delay_ms,
            faults: robot.faults.length,
          },
        ];
      }),
    );
  return Object.freeze({
    bounds: Object.freeze({ ...BOUNDS, stale_s: STALE_S, gone_s: GONE_S, tick_s }),
    get link() {
      return feed.state.kind;
    },
    get received() {
      return fleet.received;
    },
    get malformed() {
      return fleet.malformed;
    },
    get outOfOrder() {
      return fleet.outOfOrder;
    },
    get robots() {
      return robots();
    },
    /** The delays of a robot's last messages, car to page, in milliseconds, newest last. */
    delays(robot: string): number[] {
      return Array.from(fleet.robots.get(robot)?.delays.column(1) ?? []);
    },
  });
}
