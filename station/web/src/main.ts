// The page: listens to the whole fleet, shows one view of it, and costs nothing while hidden.

import { FIELD_TABLE, LIVE_MAX_RATE_HZ, type Config, type FieldTable } from "./base/contract";
import { now } from "./base/clock";
import { invited, readOnly } from "./server/admission";
import { load } from "./server/config";
import { byId, byName, el, setAttribute } from "./base/dom";
import { Alarms } from "./live/alarms";
import { Feed } from "./live/feed";
import { Fleet } from "./live/fleet";
import { Registry } from "./live/registry";
import { observer } from "./live/observer";
import { GLANCE_HZ, NONE, Viewing, type Looks } from "./link/viewing";
import { readRoute, route, unread, type Route } from "./base/route";
import { StatusBar } from "./widgets/status_bar";
import { Waiting } from "./widgets/waiting";
import { startTheme } from "./base/theme";
import { DrivePanel } from "./drive/panel";
import { StopControl } from "./drive/stop_control";
import { AlarmsView } from "./views/alarms";
import { CarView } from "./views/car";
import { CompareView } from "./views/compare";
import { CloudWatchView } from "./views/cloudwatch";
import { FleetView } from "./views/fleet";
import { HistoryView } from "./views/history";
import { InsightsView } from "./views/insights";

// The period of ages and states, and the shortest period of values and charts.
const CLOCK_S = 0.25;
const VALUES_S = 0.04;

/** The views that the bar above links to. */
const TABS = ["fleet", "insights", "alarms", "cloudwatch"] as const;

class Page {
  private readonly fleet: Fleet;
  private readonly feed: Feed;
  private readonly registry: Registry;
  private readonly viewing: Viewing;
  private readonly waiting: Waiting;
  private readonly bar: StatusBar;
  private readonly fleetView: FleetView;
  private readonly carView: CarView;
  private readonly historyView: HistoryView;
  private readonly insightsView: InsightsView;
  private readonly compareView: CompareView;
  private readonly cloudWatchView: CloudWatchView;
  private readonly alarmsView: AlarmsView;
  private readonly stops: StopControl;
  private readonly drive: DrivePanel;
  private readonly stage = byId("stage");
  private readonly tools = el("p", { class: "tools" });
  private readonly ignored = el("p", { class: "ignored", role: "status", hidden: "" });
  private route: Route = { view: "fleet" };
  private shape = -1;
  private clockAt = -Infinity;
  private valuesAt = -Infinity;

  constructor(
    config: Config,
    table: FieldTable,
  ) {
    this.fleet = new Fleet(config, table);
    this.feed = new Feed(config, table, this.fleet, (state) => {
      this.bar.linked(state);
      this.clockAt = -Infinity;
      if (state.kind === "live") this.viewing.renew();
    });
    this.registry = new Registry(config);
    this.viewing = new Viewing(config, (lease) => this.feed.lease(lease));
    this.waiting = new Waiting(config, this.registry, this.fleet);
    this.stops = new StopControl(config, (robot) => this.registry.presence(robot)?.online, () => this.drive?.show());
    this.drive = new DrivePanel(config, this.stops.stops);
    const alarms = new Alarms(config, this.fleet, table);
    this.bar = new StatusBar(config, this.fleet, alarms, this.viewing, table);
    this.fleetView = new FleetView(config, this.fleet, table, this.registry, this.stops.stops);
    this.carView = new CarView(config, this.fleet, table, this.tools, this.drive.node, () => this.arrange());
    this.historyView = new HistoryView(config, table, this.fleet);
    this.insightsView = new InsightsView(config);
    this.compareView = new CompareView(config, table, this.fleet);
    this.cloudWatchView = new CloudWatchView(config);
    this.alarmsView = new AlarmsView(config, alarms);
    byId("over").after(this.ignored);
    const why = readOnly(config);
    if (why) byId("over").after(el("p", { class: "read-only", role: "status" }, el("b", {}, "Read-only"), `: ${why.replace(/\.$/, "")}. The command `, el("code", {}, "iort invite"), " prints a link that gives one more browser the stop, the wheel and every other action."));
    for (const tab of TABS) byId(`to-${tab}`).setAttribute("href", route({ view: tab }));
    window.addEventListener("hashchange", () => (invited(location.hash) ? location.reload() : this.go()));
    window.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("visibilitychange", () => !document.hidden && this.frame());
    Object.defineProperty(window, "iort", { value: observer(this.fleet, this.feed, GONE_SHOWN_S), writable: false });
    this.go();
    this.frame();
  }

  private go(): void {
    this.route = readRoute(location.hash);
    const ignored = unread(location.hash);
    this.ignored.hidden = ignored.length === 0;
    this.ignored.textContent = ignored.length > 0 ? `Ignored in the address: ${ignored.join("; ")}.` : "";
    const { view } = this.route;
    const robot = "robot" in this.route ? this.route.robot : undefined;
    const shown = { fleet: this.fleetView, car: this.carView, history: this.historyView, insights: this.insightsView, compare: this.compareView, cloudwatch: this.cloudWatchView, alarms: this.alarmsView }[view];
    document.body.dataset["view"] = view;
    document.title = robot ? `${robot} · iort` : { fleet: "iort live", cloudwatch: "CloudWatch · iort", alarms: "Alarms · iort", compare: "Compare · iort", insights: "Insights · iort", car: "iort live", history: "iort live" }[view];
    if (this.stage.firstElementChild !== shown.node) {
      this.stage.replaceChildren(shown.node);
      window.scrollTo(0, 0);
    }
    for (const tab of TABS) {
      if (view === tab) byId(`to-${tab}`).setAttribute("aria-current", "page");
      else byId(`to-${tab}`).removeAttribute("aria-current");
    }
    if (this.route.view === "history") this.historyView.show(this.route.robot, this.route.query);
    else this.historyView.show(undefined);
    this.compareView.show(this.route.view === "compare" ? this.route.query : undefined);
    if (this.route.view === "insights") this.insightsView.show(this.route.robot, this.route.query);
    else this.insightsView.leave();
    this.cloudWatchView.show(view === "cloudwatch");
    this.stops.of(view === "car" ? robot : undefined);
    this.drive.of(view === "car" ? robot : undefined);
    this.viewing.look(this.looks());
    this.registry.watch(view === "fleet" || view === "car");
    if (this.route.view === "fleet") this.fleetView.show(this.route.query ?? {});
    if (this.route.view === "car") this.carView.open(this.route.robot, this.route.query);
    else this.carView.open(undefined);
    this.arrange();
  }

  /** The cars that the viewer sees, and how closely: alarms, the past and dashboards need no more than a car sends by itself. */
  private looks(): Looks {
    if (this.route.view === "car") return new Map([[this.route.robot, LIVE_MAX_RATE_HZ]]);
    if (this.route.view === "history") return new Map([[this.route.robot, GLANCE_HZ]]);
    return this.route.view === "fleet" ? new Map(this.fleetView.looked.map((robot) => [robot, GLANCE_HZ])) : NONE;
  }

  /** Called for a new car, a new stream and another view. */
  private arrange(): void {
    this.shape = this.fleet.shape;
    const robot = "robot" in this.route ? this.route.robot : undefined;
    this.fleetView.arrange();
    if (this.route.view === "car" && robot) {
      this.carView.show(this.fleet.robots.get(robot));
      const link = (text: string, label: string, name: string): HTMLElement =>
        el("a", { class: "tool", href: route({ view: "car", robot: name, query: this.carView.query }), "aria-label": label }, text);
      const [before, after] = this.neighbours(robot);
      this.tools.replaceChildren(
        el("a", { class: "tool", href: route({ view: "history", robot }) }, "History"),
        el("a", { class: "tool", href: route({ view: "insights", robot }) }, "Insights"),
        ...(before && after ? [link("‹", `Previous car, ${before}`, before), link("›", `Next car, ${after}`, after)] : []),
      );
    }
    // The view of a car waits for its car, as the fleet's view waits for the first.
    const waits = this.route.view === "fleet" ? this.fleet.robots.size === 0 : this.route.view === "car" && !this.fleet.robots.has(robot!);
    document.body.dataset["empty"] = String(waits);
    this.waiting.show(robot);
    this.clockAt = -Infinity;
  }

  private neighbours(robot: string): [string | undefined, string | undefined] {
    const names = [...this.fleet.robots.keys()].sort(byName);
    const at = names.indexOf(robot);
    if (names.length < 2 || at < 0) return [undefined, undefined];
    return [names.at(at - 1), names[(at + 1) % names.length]];
  }

  /** Left and right change the car; Escape leaves it. */
  private key(event: KeyboardEvent): void {
    const inField = event.target instanceof HTMLElement && event.target.matches("input, select, textarea");
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (this.route.view === "fleet") this.fleetView.key(event);
    if (this.route.view === "fleet" || inField) return;
    if (event.key === "Escape") location.hash = "robot" in this.route && this.route.view === "history" ? route({ view: "car", robot: this.route.robot }) : route({ view: "fleet" });
    if (this.route.view !== "car") return;
    const [before, after] = this.neighbours(this.route.robot);
    const to = { ArrowLeft: before, ArrowRight: after }[event.key];
    if (to !== undefined) location.hash = route({ view: "car", robot: to, query: this.carView.query });
  }

  private readonly frame = (): void => {
    if (document.hidden) return;
    requestAnimationFrame(this.frame);
    const at = now();
    if (this.fleet.shape !== this.shape) this.arrange();
    const { view } = this.route;
    if (at - this.valuesAt >= VALUES_S) {
      this.valuesAt = at;
      if (view === "car") {
        this.carView.values(at);
        this.carView.draw(at);
      }
      this.bar.speed(view === "car" ? this.carView.speed(at) : undefined);
    }
    if (at - this.clockAt < CLOCK_S) return;
    this.clockAt = at;
    this.viewing.look(this.looks());
    const linked = this.feed.state.kind === "live";
    this.bar.clock(at, this.feed.state);
    if (document.body.dataset["empty"] === "true") this.waiting.show("robot" in this.route ? this.route.robot : undefined);
    if (view === "fleet") this.fleetView.clock(at, linked);
    if (view === "car") {
      this.carView.clock(at, linked);
      this.drive.driven(this.carView.driver(at));
    }
    if (view === "history") this.historyView.clock(at);
    if (view === "alarms") this.alarmsView.clock(at);
  };
}

/** The longest delay until a car that is gone is shown so. */
const GONE_SHOWN_S = CLOCK_S;

load()
  .then((config) => {
    startTheme(byId("theme"));
    return new Page(config, FIELD_TABLE);
  })
  .catch((error: unknown) => {
    setAttribute(byId("link"), "data-state", "lost");
    byId("link-text").textContent = "Not started";
    byId("banner").hidden = false;
    byId("banner").dataset["state"] = "lost";
    byId("banner-text").textContent = `The page could not start: ${error instanceof Error ? error.message : String(error)}`;
  });
