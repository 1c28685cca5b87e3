// The bar above and the line below every view: the cars, the connection, the rejected messages.

import { now } from "../base/clock";
import { type Config, type FieldTable, LIVE } from "../base/contract";
import { byId, setAttribute, setText } from "../base/dom";
import { age, number } from "../base/format";
import type { Viewing } from "../link/viewing";
import type { LinkState } from "../link/worker_messages";
import type { Alarms } from "../live/alarms";
import type { Fleet } from "../live/fleet";

const UNABLE =
  "This page can only listen: a car sends a value every few seconds until somebody else looks at it more closely.";
const ANNOUNCE_S = 8;
const WORDS = {
  connecting: "Connecting",
  paused: "Paused",
  live: "Connected",
  lost: "Connection lost",
} as const;

/** A speed as the bar shows it. */
export interface Speed {
  readonly text: string;
  readonly old: boolean;
}

export class StatusBar {
  private reconnected: { readonly at: number; readonly downFor: number } | undefined;

  constructor(
    config: Config,
    private readonly fleet: Fleet,
    private readonly alarms: Alarms,
    private readonly viewing: Viewing,
    private readonly table: FieldTable,
  ) {
    const { live, namespace, origin } = config;
    write("way", `live over ${live === "iot" ? "AWS IoT" : "PubNub"}`);
    write("empty-channel", live === "iot" ? `${LIVE}/${namespace}/+/+` : `${namespace}.*`);
    write("empty-origin", live === "iot" ? "AWS IoT" : origin);
  }

  linked(state: LinkState): void {
    if (state.kind === "live" && state.downFor !== undefined)
      this.reconnected = { at: now(), downFor: state.downFor };
  }

  clock(at: number, link: LinkState): void {
    const { fleet } = this;
    const count = { live: 0, idle: 0, stale: 0, gone: 0 };
    for (const robot of fleet.robots.values()) count[robot.freshness(at)] += 1;
    const counts = (["live", "idle", "stale", "gone"] as const).filter((state) => count[state] > 0);
    const words = counts.map((state) => `${count[state]} ${state === "live" ? "online" : state}`);
    // The state of a car that is gone is unknown.
    const faulty = [...fleet.robots.values()].filter(
      (robot) => robot.freshness(at) !== "gone" && robot.fault(this.table) !== undefined,
    ).length;
    write("count", words.join(" · "));
    write("faulty", faulty === 0 ? "" : `${faulty} with a fault`);
    this.badge(at);
    write("received", number(fleet.received));
    write("malformed", number(fleet.malformed));
    write("malformed-last", fleet.lastRefusal ? ` (the last: ${fleet.lastRefusal})` : "");
    setAttribute(byId("malformed"), "data-bad", String(fleet.malformed > 0));
    write("late", number(fleet.outOfOrder));
    const { able, awake, error } = this.viewing;
    write("awake", able ? `${awake} ${awake === 1 ? "car" : "cars"} held awake` : "cannot wake cars");
    byId("awake").title = able ? error : UNABLE;
    setAttribute(byId("link"), "data-state", link.kind);
    write("link-text", WORDS[link.kind]);
    this.announce(link, at);
  }

  /** The car's speed beside its stop, in sight while the page scrolls. */
  speed(speed: Speed | undefined): void {
    const node = byId("speed-now");
    node.hidden = speed === undefined;
    if (!speed) return;
    write("speed-now-value", speed.text);
    setAttribute(node, "data-old", String(speed.old));
  }

  /** The number of raised alarms, on every view. */
  private badge(at: number): void {
    this.alarms.clock(at);
    const raised = this.alarms.raised(at);
    const fresh = raised.filter((alarm) => alarm.fresh).length;
    const badge = byId("alarms");
    setAttribute(badge, "data-fresh", String(fresh > 0));
    setAttribute(
      badge,
      "aria-label",
      this.alarms.error || `${raised.length} raised, ${fresh} of them not acknowledged`,
    );
    // It keeps its room, so that nothing moves when it comes and goes.
    write("alarms", raised.length > 0 ? String(raised.length) : this.alarms.error ? "?" : "");
    badge.title = this.alarms.error;
  }

  private announce(link: LinkState, at: number): void {
    let words = "";
    let detail = "";
    if (link.kind === "lost") {
      words = `Connection lost: ${link.reason}${/[.?]$/.test(link.reason) ? "" : "."}`;
      const wait = link.retryAt - at;
      detail = `${age(at - link.since)} ago. ${wait > 0.5 ? `Trying again in ${Math.ceil(wait)} s` : "Trying again now"}.`;
    } else if (this.reconnected && at - this.reconnected.at < ANNOUNCE_S) {
      words = `Connected again after ${age(this.reconnected.downFor)}.`;
    }
    const banner = byId("banner");
    setAttribute(banner, "data-state", link.kind);
    banner.hidden = words === "";
    write("banner-text", words);
    write("banner-detail", detail);
  }
}

const write = (id: string, text: string): void => setText(byId(id), text);
