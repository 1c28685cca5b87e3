// Every car: one card each. Only the cards on the screen are updated, so that hundreds cost little more than a few.

import { byName, el, Text } from "../base/dom";
import type { RouteTo } from "../base/route";
import type { Stops } from "../drive/stops";
import { GLANCE_HZ, type Looks } from "../link/viewing";
import type { Robot } from "../live/robot";
import { Card } from "../widgets/card";
import { FleetTools } from "../widgets/fleet_tools";
import { OfflineCars } from "../widgets/offline_cars";
import type { Services, View } from "./view";

// A car that is gone for longer is folded: until then, its card says so in its place.
const FOLD_S = 60;
// Cards change places at most this often, and never under the viewer's pointer or keyboard.
const PLACE_S = 2;
// A car that is asked sends its newest sample at once, and then has a card.
const MOST_COMING = 50;

export class FleetView implements View<RouteTo<"fleet">> {
  readonly node: HTMLElement;
  private readonly stops: Stops;
  private readonly nav = el("nav", { class: "cars", id: "cars", "aria-label": "Cars" });
  private readonly tools: FleetTools;
  private readonly offline: OfflineCars;
  private readonly cards = new Map<string, Card>();
  private readonly headings = new Map<string, { readonly node: HTMLElement; readonly count: Text }>();
  private readonly seen = new Set<string>();
  /** The cars of whose cards it is known whether they are on the screen. */
  private readonly judged = new Set<string>();
  private readonly nothing = el(
    "p",
    { class: "note", role: "status", hidden: "" },
    "No car has this name or tag.",
  );
  private placedAt = -Infinity;
  private known = -1;

  private readonly watcher = new IntersectionObserver(
    (entries) => {
      for (const { target, isIntersecting } of entries) {
        const name = (target as HTMLElement).dataset.robot!;
        this.judged.add(name);
        if (isIntersecting) this.seen.add(name);
        else this.seen.delete(name);
      }
      this.refresh();
    },
    { rootMargin: "25%" },
  );
  /** Updates the cards on the screen, as the last clock did. */
  private refresh: () => void = () => {};

  constructor(private readonly services: Services) {
    const { config, table, registry, stops } = services;
    this.stops = stops.stops;
    this.tools = new FleetTools(registry, table, () => (this.placedAt = -Infinity));
    this.offline = new OfflineCars(config, registry);
    this.node = el("div", { class: "fleet" }, this.tools.node, this.nothing, this.nav, this.offline.node);
  }

  /** Show the address's choice of cars. */
  show({ query = {} }: RouteTo<"fleet">): void {
    this.tools.read(query);
    this.arrange();
  }

  title(): string {
    return "iort live";
  }

  waits(): boolean {
    return this.services.fleet.robots.size === 0;
  }

  /** There are other cars, or they have moved. */
  arrange(): void {
    this.placedAt = -Infinity;
  }

  clock(now: number, linked: boolean): void {
    if (this.services.registry.version !== this.known) {
      this.known = this.services.registry.version;
      this.tools.offer();
      this.arrange();
    }
    const held = this.nav.matches(":hover, :focus-within") && this.placedAt > -Infinity;
    if (now - this.placedAt >= PLACE_S && !held) this.place(now);
    const { fleet, table, registry } = this.services;
    this.refresh = () => {
      for (const name of this.seen) {
        const robot = this.services.fleet.robots.get(name);
        if (robot)
          this.cards
            .get(name)
            ?.update(
              robot,
              { fleet, table, stop: this.stops.word(name), incidents: registry.incidentsOf(name) },
              now,
              linked,
            );
      }
    };
    this.refresh();
  }

  /** The cars whose cards are on the screen, and those whose cards are still to come. */
  looks(): Looks {
    const online = Object.entries(this.services.registry.robots ?? {}).flatMap(([name, presence]) =>
      presence.online ? [name] : [],
    );
    const coming = [...new Set([...this.services.fleet.robots.keys(), ...online])].filter(
      (name) => !this.judged.has(name) && this.tools.finds(name),
    );
    return new Map([...this.seen, ...coming.slice(0, MOST_COMING)].map((name) => [name, GLANCE_HZ]));
  }

  /** Arrow keys move between the cards, which are links: Enter opens one. A slash searches. */
  key(event: KeyboardEvent): void {
    const field = event.target instanceof Element && event.target.matches("input, select");
    if (event.key === "/" && !field) {
      event.preventDefault();
      this.tools.focus();
    }
    if (field && !(event.key === "ArrowDown" && event.target instanceof HTMLInputElement)) return;
    const cards = [...this.nav.querySelectorAll<HTMLElement>(".card")];
    const at = cards.indexOf(document.activeElement as HTMLElement);
    const to = at < 0 ? (event.key.startsWith("Arrow") ? 0 : undefined) : neighbour(cards, at, event.key);
    if (to === undefined) return;
    event.preventDefault();
    cards[to]?.focus();
  }

  /** Put the cards in order, and fold the cars that are not heard. */
  private place(now: number): void {
    this.placedAt = now;
    for (const [name, card] of this.cards) {
      if (!this.services.fleet.robots.has(name)) this.remove(card);
    }
    const found = [...this.services.fleet.robots.values()].filter(({ name }) => this.tools.finds(name));
    const folded = (robot: Robot): boolean => robot.overdue_s(now) > FOLD_S;
    const nodes: HTMLElement[] = [];
    for (const [heading, robots] of this.tools.arrange(
      found.filter((robot) => !folded(robot)),
      now,
    )) {
      if (heading !== "") nodes.push(this.heading(heading, robots.length));
      nodes.push(...robots.map(({ name }) => this.card(name).node));
    }
    let next = this.nav.firstElementChild;
    for (const node of nodes) {
      if (node === next) next = next.nextElementSibling;
      else this.nav.insertBefore(node, next);
    }
    while (next) {
      const after: Element | null = next.nextElementSibling;
      next.remove();
      next = after;
    }
    const registered = Object.entries(this.services.registry.robots ?? {}).filter(
      ([name]) => !this.services.fleet.robots.has(name) && this.tools.finds(name),
    );
    const away = [...registered, ...found.filter(folded).map((robot) => [robot.name, robot] as const)].sort(
      ([a], [b]) => byName(a, b),
    );
    this.offline.show(away, this.services.fleet.robots.size === 0);
    this.nothing.hidden = nodes.length > 0 || away.length > 0 || this.services.fleet.robots.size === 0;
    // A page without cars has nothing to search.
    this.tools.node.hidden =
      this.services.fleet.robots.size === 0 && registered.length === 0 && this.nothing.hidden;
  }

  private heading(name: string, cars: number): HTMLElement {
    let heading = this.headings.get(name);
    if (!heading) {
      heading = { node: el("h2", { class: "group" }, name), count: new Text("note") };
      heading.node.append(heading.count.node);
      this.headings.set(name, heading);
    }
    heading.count.set(String(cars));
    return heading.node;
  }

  private card(name: string): Card {
    let card = this.cards.get(name);
    if (!card) {
      card = new Card(name);
      this.cards.set(name, card);
      this.watcher.observe(card.node);
    }
    return card;
  }

  private remove(card: Card): void {
    this.watcher.unobserve(card.node);
    card.node.remove();
    this.cards.delete(card.name);
    this.seen.delete(card.name);
    this.judged.delete(card.name);
  }
}

/** The card that a key leads to; up and down it is the nearest one of the next row. */
function neighbour(cards: readonly HTMLElement[], at: number, key: string): number | undefined {
  const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: cards.length - 1 }[key];
  if (to !== undefined) return to;
  const { offsetTop: top, offsetLeft: left } = cards[at]!;
  const step = { ArrowDown: 1, ArrowUp: -1 }[key];
  if (step === undefined) return undefined;
  let best: number | undefined;
  for (let i = at + step; cards[i]; i += step) {
    const card = cards[i]!;
    if (card.offsetTop === top) continue;
    if (best !== undefined && card.offsetTop !== cards[best]!.offsetTop) break;
    if (best === undefined || Math.abs(card.offsetLeft - left) < Math.abs(cards[best]!.offsetLeft - left))
      best = i;
  }
  return best;
}
