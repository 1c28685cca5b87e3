// The row of cars: one card a car, chosen by pointer or by arrow keys.

import type { FieldTable } from "./config";
import { byName, el, setAttribute, Text } from "./dom";
import { numeric, type Fleet, type Robot } from "./fleet";
import { age, milliseconds, NOTHING, number } from "./format";

export class FleetStrip {
  private readonly cards = new Map<string, Card>();

  constructor(
    private readonly host: HTMLElement,
    private readonly fleet: Fleet,
    private readonly table: FieldTable,
    private readonly select: (robot: string) => void,
  ) {
    host.addEventListener("keydown", (event) => this.key(event));
  }

  /** Cards for the cars there are, in the order of their names. */
  arrange(selected: string | undefined): void {
    const names = [...this.fleet.robots.keys()].sort(byName);
    for (const [name, card] of this.cards) {
      if (!this.fleet.robots.has(name)) {
        card.node.remove();
        this.cards.delete(name);
      }
    }
    names.forEach((name, i) => {
      let card = this.cards.get(name);
      if (!card) {
        card = new Card(name);
        card.node.addEventListener("click", () => this.select(name));
        this.cards.set(name, card);
      }
      if (this.host.children[i] !== card.node) this.host.insertBefore(card.node, this.host.children[i] ?? null);
    });
    this.mark(selected);
  }

  mark(selected: string | undefined): void {
    for (const [name, { node }] of this.cards) {
      setAttribute(node, "aria-checked", String(name === selected));
      setAttribute(node, "tabindex", name === selected ? "0" : "-1");
    }
  }

  update(now: number, linked: boolean): void {
    for (const robot of this.fleet.robots.values()) {
      this.cards.get(robot.name)?.update(robot, this.fleet, this.table, now, linked);
    }
  }

  private key(event: KeyboardEvent): void {
    const cards = [...this.host.children] as HTMLElement[];
    const at = cards.findIndex((card) => card.getAttribute("aria-checked") === "true");
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    let to: number;
    if (step !== undefined) to = (at + step + cards.length) % cards.length;
    else if (event.key === "Home") to = 0;
    else if (event.key === "End") to = cards.length - 1;
    else return;
    event.preventDefault();
    const card = cards[to];
    if (!card) return;
    this.select(card.dataset["robot"]!);
    card.focus();
    card.scrollIntoView({ block: "nearest", inline: "nearest" });
  }
}

class Card {
  readonly node: HTMLElement;
  private readonly state = new Text("card-state");
  private readonly speed = new Text("num");
  private readonly speedUnit = new Text("unit");
  private readonly voltage = new Text("num");
  private readonly delay = new Text("num");

  constructor(name: string) {
    const figure = (value: Text, unit: Node | string): HTMLElement => el("span", { class: "figure" }, value.node, unit);
    this.node = el(
      "button",
      { type: "button", role: "radio", class: "card", "data-robot": name },
      el("span", { class: "card-head" }, el("span", { class: "dot", "aria-hidden": "true" }), el("span", { class: "card-name" }, name), this.state.node),
      el(
        "span",
        { class: "card-figures" },
        figure(this.speed, this.speedUnit.node),
        figure(this.voltage, el("span", { class: "unit" }, "V")),
        figure(this.delay, el("span", { class: "unit" }, "ms")),
      ),
    );
  }

  update(robot: Robot, fleet: Fleet, table: FieldTable, now: number, linked: boolean): void {
    const fresh = robot.freshness(now);
    setAttribute(this.node, "data-state", linked || fresh === "live" ? fresh : "unlinked");
    const silent = fresh === "gone" ? now - robot.heardAt : now - robot.takenAt;
    const state = fresh === "live" ? "live" : `${linked ? fresh : "no link"} ${age(silent)}`;
    const fault = robot.fault(table);
    this.state.set(fault ?? state);
    this.state.node.title = fault ? `${state}, fault: ${fault}` : "";
    setAttribute(this.node, "data-fault", String(fault !== undefined));
    const sample = robot.vesc(table)?.sample;
    const gain = fleet.gain(robot.name);
    const erpm = numeric(sample?.get("speed"));
    this.speed.set(gain ? number(erpm / gain, 1) : number(erpm, 0));
    this.speedUnit.set(gain ? "m/s" : "erpm");
    this.voltage.set(number(numeric(sample?.get("voltage_input")), 1));
    const delay = robot.newestDelay();
    this.delay.set(delay ? milliseconds(delay.total) : NOTHING);
  }
}
