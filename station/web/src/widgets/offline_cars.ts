// The cars that are not heard, folded: since when they are offline, and a link to their past.

import type { Config, RobotPresence } from "../base/contract";
import { el, Text } from "../base/dom";
import { when } from "../base/format";
import { route } from "../base/route";
import type { Registry } from "../live/registry";
import type { Robot } from "../live/robot";
import { IncidentsBadge } from "./incidents_badge";

export class OfflineCars {
  readonly node: HTMLDetailsElement;
  private readonly title = new Text("offline-title");
  private readonly list = el("ul");
  private drawn = "";
  private chosen = false;

  constructor(
    private readonly config: Config,
    private readonly registry: Registry,
  ) {
    const summary = el("summary", {}, this.title.node);
    summary.addEventListener("click", () => (this.chosen = true));
    this.node = el("details", { class: "offline", hidden: "" }, summary, this.list);
  }

  /** List the cars with what is known of each; the list is open while there is nothing else to see. */
  show(cars: readonly (readonly [string, RobotPresence | Robot])[], alone: boolean): void {
    if (!this.chosen) this.node.open = alone;
    const rows = cars.map(
      ([name, known]) =>
        [
          name,
          "heardAt" in known ? `last heard ${when(known.heardAt)}` : presence(known),
          this.registry.incidentsOf(name),
        ] as const,
    );
    const drawn = JSON.stringify(rows);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.node.hidden = rows.length === 0;
    this.title.set(`Not heard: ${rows.length} ${rows.length === 1 ? "car" : "cars"}`);
    const view = this.config.answers ? "history" : "car";
    this.list.replaceChildren(
      ...rows.map(([name, text, incidents]) =>
        el(
          "li",
          { "data-absent": name },
          el("a", { href: route({ view, robot: name }), title: `What ${name} did` }, name),
          " ",
          text,
          ...(incidents > 0 ? [" ", new IncidentsBadge(incidents).node] : []),
        ),
      ),
    );
  }
}

/** What the registry says of a car that sends nothing. */
export function presence({ online, since_ms }: RobotPresence): string {
  if (online) return "connected, and sends nothing live";
  return since_ms === null ? "never connected" : `offline since ${when(since_ms / 1000)}`;
}
