// The page: listens to the whole fleet, shows one view of it, and costs nothing while hidden.

import { now } from "./base/clock";
import { type Config, FIELD_TABLE, type FieldTable } from "./base/contract";
import { byId, el, setAttribute } from "./base/dom";
import { follow, type Route, type RouteTo, readRoute, route, unread } from "./base/route";
import { startTheme } from "./base/theme";
import { DrivePanel } from "./drive/panel";
import { StopControl } from "./drive/stop_control";
import { NONE, Viewing } from "./link/viewing";
import { Alarms } from "./live/alarms";
import { Feed } from "./live/feed";
import { Fleet } from "./live/fleet";
import { observer } from "./live/observer";
import { Registry } from "./live/registry";
import { invited, readOnly } from "./server/admission";
import { load } from "./server/config";
import { PicturePanel } from "./video/panel";
import { AlarmsView } from "./views/alarms";
import { CarView } from "./views/car";
import { CloudWatchView } from "./views/cloudwatch";
import { CompareView } from "./views/compare";
import { FleetView } from "./views/fleet";
import { HistoryView } from "./views/history";
import { InsightsView } from "./views/insights";
import type { Services, View } from "./views/view";
import { StatusBar } from "./widgets/status_bar";
import { Waiting } from "./widgets/waiting";

// The period of ages and states, and the shortest period of values and charts.
const CLOCK_S = 0.25;
const VALUES_S = 0.04;

/** The views that the bar above links to. */
const TABS = ["fleet", "insights", "alarms", "cloudwatch"] as const;

/** Every view by its name in an address: a new one is a line here, and its parameters in base/route.ts. */
const VIEWS: { readonly [V in Route["view"]]: new (services: Services) => View<RouteTo<V>> } = {
  fleet: FleetView,
  car: CarView,
  history: HistoryView,
  insights: InsightsView,
  compare: CompareView,
  cloudwatch: CloudWatchView,
  alarms: AlarmsView,
};
type Views = Readonly<Record<Route["view"], View>>;

class Page {
  private readonly fleet: Fleet;
  private readonly feed: Feed;
  private readonly registry: Registry;
  private readonly viewing: Viewing;
  private readonly waiting: Waiting;
  private readonly bar: StatusBar;
  private readonly views: Views;
  private readonly stops: StopControl;
  private readonly picture: PicturePanel;
  private readonly drive: DrivePanel;
  private readonly stage = byId("stage");
  private readonly ignored = el("p", { class: "ignored", role: "status", hidden: "" });
  private route: Route = { view: "fleet" };
  private view: View;
  private shape = -1;
  private clockAt = -Infinity;
  private valuesAt = -Infinity;
  /** The messages that were heard when one was drawn at once, and that time. */
  private heard = 0;
  private heardAt = -Infinity;

  constructor(config: Config, table: FieldTable) {
    this.fleet = new Fleet(config, table);
    this.feed = new Feed(config, table, this.fleet, (state) => {
      this.bar.linked(state);
      this.clockAt = -Infinity;
      if (state.kind === "live") this.viewing.renew();
    });
    this.registry = new Registry(config);
    this.viewing = new Viewing(config, (lease) => this.feed.lease(lease));
    this.waiting = new Waiting(config, this.registry, this.fleet);
    this.stops = new StopControl(
      config,
      (robot) => this.registry.presence(robot)?.online,
      () => {
        this.picture?.show();
        this.drive?.show();
      },
    );
    this.picture = new PicturePanel(config, this.stops.stops);
    this.drive = new DrivePanel(config, this.stops.stops, this.picture);
    const alarms = new Alarms(config, this.fleet, table);
    this.bar = new StatusBar(config, this.fleet, alarms, this.viewing, table);
    const services: Services = {
      config,
      table,
      fleet: this.fleet,
      registry: this.registry,
      alarms,
      stops: this.stops,
      drive: this.drive,
      picture: this.picture,
      changed: () => this.arrange(),
    };
    this.views = Object.fromEntries(
      Object.entries(VIEWS).map(([name, MadeView]) => [name, new MadeView(services)]),
    ) as unknown as Views;
    this.view = this.views.fleet;
    byId("over").after(this.ignored);
    const why = readOnly(config);
    if (why)
      byId("over").after(
        el(
          "p",
          { class: "read-only", role: "status" },
          el("b", {}, "Read-only"),
          `: ${why.split(":")[0]}. A link of `,
          el("code", {}, "iort invite"),
          " gives one more browser the stop, the wheel and every other action.",
        ),
      );
    for (const tab of TABS) byId(`to-${tab}`).setAttribute("href", route({ view: tab }));
    window.addEventListener("hashchange", () => (invited(location.hash) ? location.reload() : this.go()));
    window.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("visibilitychange", () => !document.hidden && this.frame());
    Object.defineProperty(window, "iort", {
      value: observer(this.fleet, this.feed, CLOCK_S),
      writable: false,
    });
    this.go();
    this.frame();
  }

  private go(): void {
    const address = follow();
    this.route = readRoute(address);
    const ignored = unread(address);
    this.ignored.hidden = ignored.length === 0;
    this.ignored.textContent = ignored.length > 0 ? `Ignored in the address: ${ignored.join("; ")}.` : "";
    const { view } = this.route;
    const next = this.views[view];
    if (this.view !== next) this.view.leave?.();
    this.view = next;
    document.body.dataset.view = view;
    document.title = next.title(this.route);
    if (this.stage.firstElementChild !== next.node) {
      this.stage.replaceChildren(next.node);
      window.scrollTo(0, 0);
    }
    for (const tab of TABS) {
      if (view === tab) byId(`to-${tab}`).setAttribute("aria-current", "page");
      else byId(`to-${tab}`).removeAttribute("aria-current");
    }
    this.registry.watch(view === "fleet" || view === "car");
    const car = view === "car" ? this.robot : undefined;
    this.stops.of(car);
    this.picture.of(car);
    this.drive.of(car);
    next.show(this.route);
    this.look();
    this.arrange();
  }

  private get robot(): string | undefined {
    return "robot" in this.route ? this.route.robot : undefined;
  }

  /** Alarms, findings and dashboards need no more than a car sends by itself. */
  private look(): void {
    this.viewing.look(this.view.looks?.() ?? NONE);
  }

  /** Called for a new car, a new stream and another view. */
  private arrange(): void {
    this.shape = this.fleet.shape;
    this.view.arrange?.();
    // The view of a car waits for its car, as the fleet's view waits for the first.
    document.body.dataset.empty = String(this.view.waits?.() ?? false);
    this.waiting.show(this.robot);
    this.clockAt = -Infinity;
  }

  /** Escape leaves a view; what other keys do is the view's. */
  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const inField = event.target instanceof HTMLElement && event.target.matches("input, select, textarea");
    if (this.route.view !== "fleet" && inField) return;
    this.view.key?.(event);
    if (event.key !== "Escape" || this.route.view === "fleet") return;
    location.hash =
      this.route.view === "history"
        ? route({ view: "car", robot: this.route.robot })
        : route({ view: "fleet" });
  }

  private readonly frame = (): void => {
    if (document.hidden) return;
    requestAnimationFrame(this.frame);
    const at = now();
    if (this.fleet.shape !== this.shape) this.arrange();
    // A message after a pause is drawn with this frame, and does not wait for the next turn.
    const heard = this.fleet.received !== this.heard && at - this.heardAt >= VALUES_S;
    if (heard) [this.heard, this.heardAt] = [this.fleet.received, at];
    if (heard || at - this.valuesAt >= VALUES_S) {
      this.valuesAt = at;
      this.view.values?.(at);
      this.bar.speed(this.view.speed?.(at));
    }
    if (at - this.clockAt < CLOCK_S) return;
    this.clockAt = at;
    this.look();
    this.bar.clock(at, this.feed.state);
    if (document.body.dataset.empty === "true") this.waiting.show(this.robot);
    this.view.clock?.(at, this.feed.state.kind === "live");
  };
}

load()
  .then((config) => {
    startTheme(byId("theme"));
    return new Page(config, FIELD_TABLE);
  })
  .catch((error: unknown) => {
    setAttribute(byId("link"), "data-state", "lost");
    byId("link-text").textContent = "Not started";
    byId("banner").hidden = false;
    byId("banner").dataset.state = "lost";
    byId("banner-text").textContent =
      `The page could not start: ${error instanceof Error ? error.message : String(error)}`;
  });
