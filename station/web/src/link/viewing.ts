// The leases that this page holds on cars' live lanes: a car sends at the highest rate that its viewers ask for, and
// next to nothing without one. A lease ends by itself, so a page that dies costs no more than the rest of it.

import { type Config, VIEW_LEASE_MS, VIEW_RENEW_S } from "../base/contract";
import { newName } from "../base/dom";
import { act, words } from "../server/answers";
import type { Lease } from "./worker_messages";

/** The rate of a card among others, and of a value beside the past. */
export const GLANCE_HZ = 1;

/** Robot -> messages a second. */
export type Looks = ReadonlyMap<string, number>;

export const NONE: Looks = new Map();

/** Whether the page has its own connection to the broker; a static site's may only listen. */
const connected = ({ live, identity }: Config): boolean => live === "iot" && identity === null;

/** Whether the page can ask cars for more than they send by themselves. */
export const asks = (config: Config): boolean => config.actions.includes("view") || connected(config);

export class Viewing {
  readonly able: boolean;
  private readonly served: boolean;
  private readonly connected: boolean;
  /** Why the newest lease was not sent. */
  error = "";
  private readonly viewer = newName();
  private looks = NONE;
  private held = NONE;

  /** `lease` asks over the page's own connection to the broker. */
  constructor(
    config: Config,
    private readonly lease: (lease: Lease) => void,
  ) {
    this.served = config.actions.includes("view");
    this.connected = connected(config);
    this.able = asks(config);
    if (!this.able) return;
    document.addEventListener("visibilitychange", () => this.hold());
    window.addEventListener("pagehide", () => this.hold(NONE));
    window.setInterval(() => this.renew(), VIEW_RENEW_S * 1000);
  }

  /** The cars that this page holds awake. */
  get awake(): number {
    return this.error === "" ? this.held.size : 0;
  }

  /** Look at these cars from now on. */
  look(looks: Looks): void {
    this.looks = looks;
    if (this.able) this.hold();
  }

  /** Ask for everything that is looked at again. */
  renew(): void {
    if (this.able) this.hold(undefined, true);
  }

  /** Ask for what is looked at and not held yet, or for all of it, and end the other leases. */
  private hold(looks = document.hidden ? NONE : this.looks, again = false): void {
    const asked = [...looks].filter(([robot, rate_hz]) => again || this.held.get(robot) !== rate_hz);
    for (const rate_hz of new Set(asked.map(([, each_hz]) => each_hz))) {
      this.send(
        asked.flatMap(([robot, each_hz]) => (each_hz === rate_hz ? [robot] : [])),
        rate_hz,
        VIEW_LEASE_MS,
      );
    }
    const ended = [...this.held.keys()].filter((robot) => !looks.has(robot));
    if (ended.length > 0) this.send(ended, GLANCE_HZ, 0);
    this.held = looks;
  }

  private send(robots: readonly string[], rate_hz: number, lease_ms: number): void {
    const { viewer } = this;
    // The last word of a page that is closed must outlive it, and its connection does not.
    if (this.connected && (lease_ms > 0 || !this.served)) {
      this.lease({ robots, viewer, rate_hz, lease_ms });
      return;
    }
    const asked = {
      robots: robots.join(","),
      viewer,
      rate_hz: String(rate_hz),
      lease_ms: String(lease_ms),
      ...(this.connected ? { broker: "yes" } : {}),
    };
    act("view", asked, { keepalive: lease_ms === 0 })
      .then(() => {
        this.error = "";
        // A car that is looked at again meanwhile may have heard of it before it heard of the end.
        if (lease_ms === 0 && robots.some((robot) => this.held.has(robot))) this.renew();
      })
      .catch((error: unknown) => (this.error = words(error)));
  }
}
