// Every car: one card each, in the order of their names, so that a card stays where it is.

import type { Config, FieldTable } from "../base/contract";
import { AbsentCars } from "../widgets/absent_cars";
import { byName, el, setAttribute, Text } from "../base/dom";
import type { Fleet } from "../live/fleet";
import { numeric, type Robot } from "../live/robot";
import { age, linear, milliseconds, NOTHING, number } from "../base/format";
import { route } from "../base/route";
import { Sparkline } from "../charts/sparkline";
import { hottest } from "../charts/car_charts";

export class FleetView {
  readonly node: HTMLElement;
  private readonly nav = el("nav", { class: "cars", id: "cars", "aria-label": "Cars" });
  private readonly absent: AbsentCars;
  private readonly cards = new Map<string, Card>();

  constructor(
    config: Config,
    private readonly fleet: Fleet,
    private readonly table: FieldTable,
  ) {
    this.absent = new AbsentCars(config, fleet);
    this.node = el("div", { class: "fleet" }, this.nav, this.absent.node);
    this.nav.addEventListener("keydown", (event) => this.key(event));
  }

  show(shown: boolean): void {
    this.absent.show(shown);
  }

  /** Cards for the cars there are. */
  arrange(): void {
    for (const [name, card] of this.cards) {
      if (!this.fleet.robots.has(name)) {
        card.node.remove();
        this.cards.delete(name);
      }
    }
    [...this.fleet.robots.keys()].sort(byName).forEach((name, i) => {
      let card = this.cards.get(name);
      if (!card) {
        card = new Card(name);
        this.cards.set(name, card);
      }
      if (this.nav.children[i] !== card.node) this.nav.insertBefore(card.node, this.nav.children[i] ?? null);
    });
    this.absent.arrange();
  }

  clock(now: number, linked: boolean): void {
    for (const robot of this.fleet.robots.values()) {
      this.cards.get(robot.name)?.update(robot, this.fleet, this.table, now, linked);
    }
  }

  /** Arrow keys move between the cards, which are links: Enter opens one. */
  private key(event: KeyboardEvent): void {
    const cards = [...this.nav.children] as HTMLElement[];
    const at = cards.indexOf(document.activeElement as HTMLElement);
    // The number of cards in the first row.
    const columns = Math.max(1, cards.filter((card) => card.offsetTop === cards[0]!.offsetTop).length);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, ArrowDown: at + columns, ArrowUp: at - columns, Home: 0, End: cards.length - 1 }[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    cards[to]?.focus();
  }
}

class Card {
  readonly node: HTMLElement;
  private readonly state = new Text("card-state");
  private readonly speed = new Text("num");
  private readonly speedUnit = new Text("unit");
  private readonly voltage = new Text("num");
  private readonly temperature = new Text("num");
  private readonly delay = new Text("num");
  private readonly freshness = new Text("num");
  private readonly fault = new Text("card-fault");
  private readonly spark = new Sparkline();

  constructor(name: string) {
    const figure = (label: string, value: Text, unit: Node | string): HTMLElement =>
      el("span", { class: "figure" }, el("span", { class: "figure-label" }, label), el("span", {}, value.node, unit));
    const unit = (text: string): HTMLElement => el("span", { class: "unit" }, text);
    this.node = el(
      "a",
      { class: "card", href: route({ view: "car", robot: name }), "data-robot": name },
      el("span", { class: "card-head" }, el("span", { class: "dot", "aria-hidden": "true" }), el("span", { class: "card-name", title: name }, name), this.state.node),
      el("span", { class: "card-main" }, el("span", { class: "card-speed" }, this.speed.node, this.speedUnit.node), this.spark.node),
      el(
        "span",
        { class: "card-figures" },
        figure("Battery", this.voltage, unit("V")),
        figure("Temp.", this.temperature, unit("°C")),
        figure("Delay", this.delay, unit("ms")),
        figure("Age", this.freshness, ""),
      ),
      this.fault.node,
    );
  }

  update(robot: Robot, fleet: Fleet, table: FieldTable, now: number, linked: boolean): void {
    const fresh = robot.freshness(now);
    const shown = linked || fresh === "live" ? fresh : "unlinked";
    setAttribute(this.node, "data-state", shown);
    this.state.set({ live: "online", stale: "stale", gone: "gone", unlinked: "no link" }[shown]);
    this.freshness.set(age(now - (fresh === "gone" ? robot.heardAt : robot.takenAt)));
    const fault = robot.fault(table);
    // The state of a car that is gone is unknown.
    this.fault.set(fresh === "gone" ? (fault ? `${fault}, when last heard` : "not heard from") : (fault ?? "no fault"));
    setAttribute(this.node, "data-fault", String(fault !== undefined));
    const vesc = robot.vesc(table);
    const newest = (field: string): number => numeric(vesc?.sample.get(field));
    const speed = fleet.speed(robot.name);
    this.speed.set(speed ? number(linear(newest("speed"), speed), 1) : number(newest("speed"), 0));
    this.speedUnit.set(speed ? "m/s" : "erpm");
    this.voltage.set(number(newest("voltage_input"), 1));
    this.temperature.set(number(hottest(newest), 0));
    const delay = robot.newestDelay();
    this.delay.set(delay ? milliseconds(delay.total) : NOTHING);
    if (vesc) this.spark.draw(vesc.history, vesc.columns.get("speed"), now);
  }
}
