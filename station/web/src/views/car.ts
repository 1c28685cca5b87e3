// One car in full: gauges, the viewer's charts, the delay by hop, faults, and every field of every stream.

import { INCIDENT_STREAM, LIVE_MAX_RATE_HZ, LOG_STREAM } from "../base/contract";
import { byName, el, setAttribute, Text } from "../base/dom";
import { AS_SENT, age, type Linear, linear, number } from "../base/format";
import { type Query, type Route, type RouteTo, route, setAddress } from "../base/route";
import { AgentLog } from "../car/agent_log";
import { Board } from "../car/board";
import { BoardTools } from "../car/board_tools";
import { GAUGES } from "../car/car_charts";
import { Commands } from "../car/commands";
import { FaultLog } from "../car/fault_log";
import { StreamSection } from "../car/field_tiles";
import { Settings } from "../car/settings";
import { Gauge } from "../charts/gauge";
import { Waterfall } from "../charts/waterfall";
import type { Looks } from "../link/viewing";
import { asks } from "../link/viewing";
import { MEDIAN_S, WINDOW_S } from "../live/bounds";
import { Past } from "../live/past";
import { Ring } from "../live/ring";
import { median, type Robot } from "../live/robot";
import { numeric, type Stream } from "../live/stream";
import { may } from "../server/admission";
import { foxglove } from "../widgets/foxglove";
import { IncidentsPanel } from "../widgets/incidents_panel";
import { NotesPanel } from "../widgets/notes_panel";
import type { Speed } from "../widgets/status_bar";
import type { Services, View } from "./view";

// Values are updated at most 25 times a second.
const SCREENS = 25 * MEDIAN_S;

export class CarView implements View<RouteTo<"car">> {
  readonly node: HTMLElement;
  private readonly links = el("p", { class: "tools" });
  private readonly heading = new Text("car-name", "h2");
  private readonly state = new Text("car-state");
  private readonly asks: boolean;
  private readonly fault = el("p", { class: "fault", role: "alert", hidden: "" });
  private readonly malformed = new Text("garbled", "p");
  private readonly gauges: readonly Gauge[];
  private readonly gaugeRow = el("div", { class: "gauges" });
  private readonly board: Board;
  private readonly tools: BoardTools;
  private readonly past: Past;
  private readonly commands = new Commands();
  private readonly settings = new Settings();
  private readonly log: AgentLog;
  private readonly incidents: IncidentsPanel;
  private readonly notes: NotesPanel;
  private readonly streams = el("div", { class: "streams" });
  private readonly waterfall: Waterfall;
  private readonly faults = new FaultLog();
  private readonly sections = new Map<Stream, StreamSection>();
  private robot: Robot | undefined;
  private name = "";
  private drawn = -1;
  /** The time at which a message was drawn, and its delay since arrival in milliseconds. */
  private screens = new Ring(2, SCREENS, MEDIAN_S);

  constructor(private readonly services: Services) {
    const { config, table, drive, picture, changed } = services;
    this.asks = asks(config);
    this.past = new Past(config);
    this.waterfall = new Waterfall(config);
    this.log = new AgentLog(config);
    this.incidents = new IncidentsPanel(config);
    this.notes = new NotesPanel(config, { kept: () => this.incidents.expect() });
    this.gauges = GAUGES.map((each) => new Gauge(each));
    this.gaugeRow.append(...this.gauges.map(({ node }) => node));
    this.board = new Board(table, config.track, () => this.tools.arranged());
    this.tools = new BoardTools(this.board, table, () => {
      this.drawn = -1;
      setAddress({ view: "car", robot: this.name, query: this.query });
      changed();
    });
    this.node = el(
      "article",
      { class: "car", id: "car" },
      el("header", { class: "car-head" }, this.heading.node, this.state.node, this.fault, this.links),
      this.malformed.node,
      this.gaugeRow,
      el("div", { class: "cockpit" }, picture.node, drive.node),
      this.tools.node,
      el(
        "div",
        { class: "board" },
        this.board.node,
        el(
          "aside",
          { class: "aside" },
          this.waterfall.node,
          this.faults.node,
          this.log.node,
          this.incidents.node,
          this.notes.node,
          ...(may(config, "send") ? [this.commands.node, this.settings.node] : []),
        ),
      ),
      this.streams,
    );
  }

  /** The charts and their window, as the address has them. */
  private get query(): Query<"car"> {
    return this.tools.query;
  }

  /** Show what the address says; undefined when the viewer leaves. */
  title({ robot }: RouteTo<"car">): string {
    return `${robot} · iort`;
  }

  waits(): boolean {
    return !this.services.fleet.robots.has(this.name);
  }

  looks(): Looks {
    return new Map([[this.name, LIVE_MAX_RATE_HZ]]);
  }

  leave(): void {
    this.incidents.stop();
    this.services.fleet.watch(undefined);
    this.past.fill(undefined, 0);
    this.hear(undefined);
  }

  show({ robot: name, query = {} }: RouteTo<"car">): void {
    this.name = name;
    this.commands.of(name);
    this.settings.of(name);
    this.log.of(name);
    this.incidents.show(name);
    void this.notes.show(name);
    this.tools.read(query);
    this.drawn = -1;
  }

  /** Show a car, undefined while it is not heard. */
  private hear(robot: Robot | undefined): void {
    if (this.robot !== robot) {
      this.robot = robot;
      this.sections.clear();
      this.streams.replaceChildren();
      for (const gauge of this.gauges) gauge.reset();
      this.drawn = -1;
      this.screens = new Ring(2, SCREENS, MEDIAN_S);
      this.heading.set(robot?.name ?? "");
      this.tools.of(robot);
      this.settings.heard(robot);
      this.services.fleet.watch(robot);
    }
    this.arrangeStreams();
  }

  /** Show the car if it is heard, with its streams and its neighbours. */
  arrange(): void {
    this.hear(this.services.fleet.robots.get(this.name));
    const [before, after] = this.neighbours();
    const tool = (text: string, to: Route, label = text): HTMLElement =>
      el("a", { class: "tool", href: route(to), "aria-label": label }, text);
    const car = (text: string, label: string, robot: string): HTMLElement =>
      tool(text, { view: "car", robot, query: this.query }, `${label}, ${robot}`);
    this.links.replaceChildren(
      tool("History", { view: "history", robot: this.name }),
      tool("Insights", { view: "insights", robot: this.name }),
      ...(this.services.config.answers ? [foxglove(() => this.name)] : []),
      ...(before && after ? [car("‹", "Previous car", before), car("›", "Next car", after)] : []),
    );
  }

  /** Left and right change the car. */
  key(event: KeyboardEvent): void {
    const [before, after] = this.neighbours();
    const to = { ArrowLeft: before, ArrowRight: after }[event.key];
    if (to !== undefined) location.hash = route({ view: "car", robot: to, query: this.query });
  }

  private neighbours(): [string | undefined, string | undefined] {
    const names = [...this.services.fleet.robots.keys()].sort(byName);
    const at = names.indexOf(this.name);
    if (names.length < 2 || at < 0) return [undefined, undefined];
    return [names.at(at - 1), names[(at + 1) % names.length]];
  }

  /** Make a section for each stream; called when a stream is new. */
  private arrangeStreams(): void {
    const { robot } = this;
    const { table } = this.services;
    if (!robot) return;
    const vesc = robot.vesc(table);
    const gauged = new Set(vesc ? GAUGES.flatMap(({ fields }) => fields) : []);
    this.gaugeRow.hidden = vesc === undefined;
    const ordered = [...robot.streams.values()].sort(
      (a, b) => Number(b === vesc) - Number(a === vesc) || byName(a.name, b.name),
    );
    for (const stream of ordered) {
      // They have lists of their own.
      if (stream.name === LOG_STREAM || stream.name === INCIDENT_STREAM) continue;
      let section = this.sections.get(stream);
      if (!section) {
        const except: ReadonlySet<string> = stream === vesc ? gauged : new Set();
        section = new StreamSection(stream, table, except, (key) => this.board.toggle(key));
        this.sections.set(stream, section);
      }
      this.streams.append(section.node);
    }
  }

  /** Update what changes with a message. */
  values(now: number): void {
    const { robot } = this;
    if (!robot) return;
    if (robot.version !== this.drawn) this.write(robot, now);
    this.board.draw(now);
  }

  private write(robot: Robot, now: number): void {
    const { table } = this.services;
    // What is drawn first was heard before the viewer came.
    if (this.drawn >= 0) this.screens.push([now, (now - robot.heardAt) * 1000]);
    this.drawn = robot.version;
    const vesc = robot.vesc(table);
    const speed = this.services.fleet.speed(robot.name);
    const newest = (field: string): number => numeric(vesc?.sample.get(field));
    GAUGES.forEach((each, i) => {
      const show = each.show(newest, robot, speed);
      const [least, most] =
        vesc && each.extent ? extent(vesc, each.extent, now, show.as ?? AS_SENT) : [NaN, NaN];
      this.gauges[i]!.set(show.value, least, most, show.unit, show.digits);
    });
    this.board.values(robot, speed);
    for (const section of this.sections.values()) section.values();
    const fault = robot.fault(table);
    const text = fault ? `Fault: ${fault}` : "";
    if (this.fault.textContent !== text) this.fault.textContent = text;
    this.fault.hidden = !fault;
  }

  /** Update what changes with time. */
  clock(now: number, linked: boolean): void {
    const { robot } = this;
    this.services.drive.driven(robot?.driver(now));
    if (!robot) return;
    this.past.fill(robot, this.tools.window_s);
    const charted = new Set(this.board.keys);
    for (const section of this.sections.values()) section.clock(now, charted);
    const screens = this.screens.column(1, now - MEDIAN_S);
    this.waterfall.refresh(robot, now, screens.length > 0 ? median(screens) : NaN);
    this.faults.refresh(robot);
    const { messages, reason } = this.services.fleet.refused.get(robot.name) ?? { messages: 0, reason: "" };
    this.malformed.set(
      messages > 0
        ? `${messages} live ${messages === 1 ? "message" : "messages"} of this car could not be read; the last: ${reason}.`
        : "",
    );
    this.malformed.node.hidden = messages === 0;
    this.log.refresh(robot);
    const fresh = robot.freshness(now);
    setAttribute(this.node, "data-state", linked || fresh === "live" ? fresh : "unlinked");
    const texts = {
      live: "live",
      idle: `idle: newest values are ${age(now - robot.takenAt)} old${this.asks ? "" : ", and this page cannot ask for more"}`,
      stale: `stale: newest values are ${age(now - robot.takenAt)} old`,
      gone: `gone: last heard ${age(now - robot.heardAt)} ago`,
    };
    this.state.set(
      linked || fresh === "live" ? texts[fresh] : `no connection: values are ${age(now - robot.heardAt)} old`,
    );
  }

  /** The newest speed with its unit, and whether it is old; undefined for a car without one. */
  speed(now: number): Speed | undefined {
    const { robot } = this;
    const vesc = robot?.vesc(this.services.table);
    if (!robot || !vesc?.sample.has("speed")) return undefined;
    const {
      value,
      unit = "m/s",
      digits = 2,
    } = GAUGES.find(({ name }) => name === "speed_mps")!.show(
      (field) => numeric(vesc.sample.get(field)),
      robot,
      this.services.fleet.speed(robot.name),
    );
    return { text: `${number(value, digits)} ${unit}`, old: robot.freshness(now) !== "live" };
  }
}

/** The minimum and maximum of a field in the last 30 s. */
function extent(stream: Stream, field: string, now: number, as: Linear): [number, number] {
  const column = stream.columns.get(field);
  if (column === undefined) return [NaN, NaN];
  let [low, high] = [Infinity, -Infinity];
  for (const value of stream.history.column(column, now - WINDOW_S)) {
    const shown = linear(value, as);
    if (shown < low) low = shown;
    if (shown > high) high = shown;
  }
  return [low, high];
}
