// The live page: listens to the whole fleet, shows one car in full, and costs nothing while hidden.

import { CarView } from "./carview";
import { load } from "./config";
import { byId, setAttribute } from "./dom";
import { Fleet, type Robot } from "./fleet";
import { FleetStrip } from "./fleetstrip";
import { age, number } from "./format";
import { Link, type LinkState } from "./link";
import { startTheme } from "./theme";

// Ages and states are written this often; values as they come.
const CLOCK_S = 0.25;
const ANNOUNCE_S = 8;

const now = (): number => performance.now() / 1000;

async function main(): Promise<void> {
  startTheme(byId("theme"));
  const { config, table } = await load();
  const fleet = new Fleet(config, table);
  let selected: Robot | undefined;
  let drawnShape = -1;
  let clockAt = -Infinity;
  let reconnected: { readonly at: number; readonly downFor: number } | undefined;

  const link = new Link(
    config,
    now,
    (channel, message) => fleet.take(channel, message, Date.now() * 1000, now()),
    (state) => {
      if (state.kind === "live" && state.downFor !== undefined) reconnected = { at: now(), downFor: state.downFor };
      clockAt = -Infinity;
    },
  );
  const strip = new FleetStrip(byId("cars"), fleet, table, (name) => {
    history.replaceState(null, "", `#${name}`);
    wanted = name;
    arrange();
  });
  const view = new CarView(byId("car"), fleet, table);
  const text = (id: string, value: string): void => {
    const node = byId(id);
    if (node.textContent !== value) node.textContent = value;
  };
  text("empty-channel", `${config.namespace}.*`);
  text("empty-origin", config.origin);

  // The car that the viewer, or the address, asks for; the first one heard until then.
  let wanted = location.hash.slice(1);
  window.addEventListener("hashchange", () => {
    wanted = location.hash.slice(1);
    arrange();
  });
  const arrange = (): void => {
    drawnShape = fleet.shape;
    const known = selected && fleet.robots.get(selected.name);
    selected = fleet.robots.get(wanted) ?? known ?? fleet.robots.values().next().value;
    strip.arrange(selected?.name);
    view.show(selected);
    document.body.dataset["empty"] = String(fleet.robots.size === 0);
    clockAt = -Infinity;
  };

  const clock = (at: number): void => {
    const linked = link.state.kind === "live";
    strip.update(at, linked);
    view.clock(at, linked);
    const count = { live: 0, stale: 0, gone: 0 };
    for (const robot of fleet.robots.values()) count[robot.freshness(at)] += 1;
    const counts = (["live", "stale", "gone"] as const).filter((state) => count[state] > 0);
    text("count", counts.map((state) => `${count[state]} ${state}`).join(" · "));
    showLink(link.state, at);
    text("received", number(fleet.received));
    text("malformed", number(fleet.malformed));
    byId("malformed").title = fleet.lastRefusal ? `the last one: ${fleet.lastRefusal}` : "";
    text("late", number(fleet.outOfOrder));
  };
  const showLink = (state: LinkState, at: number): void => {
    setAttribute(byId("link"), "data-state", state.kind);
    text("link-text", { connecting: "Connecting", paused: "Paused", live: "Connected", lost: "Connection lost" }[state.kind]);
    const banner = byId("banner");
    let words = "";
    let detail = "";
    if (state.kind === "lost") {
      words = `Connection lost: ${state.reason}.`;
      const wait = state.retryAt - at;
      detail = `${age(at - state.since)} ago. ${wait > 0.5 ? `Trying again in ${Math.ceil(wait)} s` : "Trying again now"}.`;
    } else if (reconnected && at - reconnected.at < ANNOUNCE_S) {
      words = `Connected again after ${age(reconnected.downFor)}.`;
    }
    setAttribute(banner, "data-state", state.kind);
    banner.hidden = words === "";
    text("banner-text", words);
    text("banner-detail", detail);
  };

  const frame = (): void => {
    if (document.hidden) return;
    requestAnimationFrame(frame);
    const at = now();
    if (fleet.shape !== drawnShape) arrange();
    view.values(at);
    if (at - clockAt >= CLOCK_S) {
      clockAt = at;
      clock(at);
    }
    view.draw(at);
  };
  document.addEventListener("visibilitychange", () => !document.hidden && requestAnimationFrame(frame));

  Object.defineProperty(window, "iort", { value: observer(fleet, link), writable: false });
  link.connect();
  requestAnimationFrame(frame);
}

/** What tests and the curious may read; every access makes a copy, so nothing can be changed through it. */
function observer(fleet: Fleet, link: Link): object {
  const robots = (): object =>
    Object.fromEntries(
      [...fleet.robots.values()].map((robot) => {
        const at = now();
        const streams = [...robot.streams.values()].map(({ name, boot, seq, t_us, hops, sample, received, takenAt }) => [
          name,
          { boot, seq, t: t_us, hops: { ...hops }, sample: Object.fromEntries(sample), received, age_s: at - takenAt },
        ]);
        const delay_ms = { newest: robot.newestDelay(), median: robot.medianDelay(at) };
        return [robot.name, { state: robot.freshness(at), streams: Object.fromEntries(streams), delay_ms }];
      }),
    );
  return Object.freeze({
    get link() {
      return link.state.kind;
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

main().catch((error: unknown) => {
  setAttribute(byId("link"), "data-state", "lost");
  byId("link-text").textContent = "Not started";
  byId("banner").hidden = false;
  byId("banner").dataset["state"] = "lost";
  byId("banner-text").textContent = `The page could not start: ${error instanceof Error ? error.message : String(error)}`;
});
