// A car's card on the fleet's view. Its inside is made when it is first seen: a fleet may have hundreds.

import type { FieldTable } from "../base/contract";
import { el, setAttribute, Text } from "../base/dom";
import { age, linear, milliseconds, NOTHING, number } from "../base/format";
import { route } from "../base/route";
import { Sparkline } from "../charts/sparkline";
import type { Word } from "../drive/stops";
import type { Fleet } from "../live/fleet";
import { hottest, type Robot } from "../live/robot";
import { CARD_FIELD, numeric } from "../live/stream";
import { IncidentsBadge } from "./incidents_badge";

export class Card {
  readonly node: HTMLElement;
  private readonly state = new Text("card-state");
  private readonly stop = new Text("card-stop");
  private readonly incidents = new IncidentsBadge();
  private inside: Inside | undefined;

  constructor(readonly name: string) {
    this.node = el(
      "a",
      { class: "card", href: route({ view: "car", robot: name }), "data-robot": name, title: name },
      el(
        "span",
        { class: "card-head" },
        el("span", { class: "dot", "aria-hidden": "true" }),
        el("span", { class: "card-name" }, name),
        this.incidents.node,
        this.state.node,
      ),
    );
  }

  update(
    robot: Robot,
    {
      fleet,
      table,
      stop,
      incidents,
    }: {
      readonly fleet: Fleet;
      readonly table: FieldTable;
      readonly stop: Word;
      /** How many the last day had. */
      readonly incidents: number;
    },
    now: number,
    linked: boolean,
  ): void {
    if (!this.inside) {
      this.inside = new Inside();
      this.node.append(this.stop.node, ...this.inside.nodes);
    }
    const fresh = robot.freshness(now);
    const shown = linked || fresh === "live" ? fresh : "unlinked";
    setAttribute(this.node, "data-state", shown);
    const driver = robot.driver(now);
    this.state.set(
      driver !== undefined
        ? `${driver} drives`
        : { live: "online", idle: "idle", stale: "stale", gone: "gone", unlinked: "no link" }[shown],
    );
    setAttribute(this.node, "data-fault", String(robot.fault(table) !== undefined));
    this.incidents.set(incidents);
    setAttribute(this.node, "data-stop", stop.kind);
    this.stop.set(
      {
        stands: "stands: emergency stop",
        moves: `does NOT stand: ${stop.why}`,
        unable: "no emergency stop",
        "": "",
      }[stop.kind],
    );
    this.stop.node.title = stop.why;
    this.inside.update(robot, fleet, table, now);
  }
}

class Inside {
  readonly nodes: readonly HTMLElement[];
  private readonly speed = new Text("num");
  private readonly speedUnit = new Text("unit");
  private readonly voltage = new Text("num");
  private readonly temperature = new Text("num");
  private readonly delay = new Text("num");
  private readonly freshness = new Text("num");
  private readonly fault = new Text("card-fault");
  private readonly spark = new Sparkline();
  private drawn = -1;

  constructor() {
    const figure = (label: string, value: Text, unit: Node | string): HTMLElement =>
      el(
        "span",
        { class: "figure" },
        el("span", { class: "figure-label" }, label),
        el("span", {}, value.node, unit),
      );
    const unit = (text: string): HTMLElement => el("span", { class: "unit" }, text);
    this.nodes = [
      el(
        "span",
        { class: "card-main" },
        el("span", { class: "card-speed" }, this.speed.node, this.speedUnit.node),
        this.spark.node,
      ),
      el(
        "span",
        { class: "card-figures" },
        figure("Battery", this.voltage, unit("V")),
        figure("Temp.", this.temperature, unit("°C")),
        figure("Delay", this.delay, unit("ms")),
        figure("Age", this.freshness, ""),
      ),
      this.fault.node,
    ];
  }

  update(robot: Robot, fleet: Fleet, table: FieldTable, now: number): void {
    const gone = robot.freshness(now) === "gone";
    this.freshness.set(age(now - (gone ? robot.heardAt : robot.takenAt)));
    const fault = robot.fault(table);
    // The state of a car that is gone is unknown.
    this.fault.set(gone ? (fault ? `${fault}, when last heard` : "not heard from") : (fault ?? "no fault"));
    const vesc = robot.vesc(table);
    if (vesc) this.spark.draw(vesc.history, vesc.columns.get(CARD_FIELD), now);
    if (robot.version === this.drawn) return;
    this.drawn = robot.version;
    const newest = (field: string): number => numeric(vesc?.sample.get(field));
    const speed = fleet.speed(robot.name);
    this.speed.set(speed ? number(linear(newest("speed"), speed), 1) : number(newest("speed"), 0));
    this.speedUnit.set(speed ? "m/s" : "erpm");
    this.voltage.set(number(newest("voltage_input"), 1));
    this.temperature.set(number(hottest(newest), 0));
    const delay = robot.newestDelay();
    this.delay.set(delay ? milliseconds(delay.total) : NOTHING);
  }
}
