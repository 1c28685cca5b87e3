// What is shown instead of cars or of a car: nothing was heard yet. It tells an unknown car from one that is off.

import type { Config } from "../base/contract";
import { byId, byName, setText } from "../base/dom";
import { capital } from "../base/format";
import { route } from "../base/route";
import type { Fleet } from "../live/fleet";
import type { Registry } from "../live/registry";
import { presence } from "./offline_cars";

const MOST_NAMES = 8;

export class Waiting {
  constructor(
    private readonly config: Config,
    private readonly registry: Registry,
    private readonly fleet: Fleet,
  ) {}

  /** Say what is known of the car, or of no car yet. */
  show(robot: string | undefined): void {
    const { robots } = this.registry;
    const known = robot === undefined ? undefined : this.registry.presence(robot);
    const unknown = robot !== undefined && robots !== undefined && !known;
    const off = known && !known.online ? known : undefined;
    const comes = "It appears here with its first live message.";
    write(
      "empty-title",
      unknown ? `There is no car ${robot}` : off ? `${robot} is offline` : `Waiting for ${robot ?? "a car"}`,
    );
    const refused = robot === undefined ? undefined : this.fleet.refused.get(robot);
    const state = known ? `${capital(presence(known))}. ${comes}` : comes;
    write(
      "empty-text",
      refused
        ? `${refused.messages} live messages came and could not be read; the last: ${refused.reason}.`
        : unknown
          ? registered(Object.keys(robots))
          : state,
    );
    byId("empty-listening").hidden = unknown || off !== undefined;
    const past = byId("empty-past");
    past.hidden = robot === undefined || unknown || !this.config.answers;
    if (robot !== undefined) past.setAttribute("href", route({ view: "history", robot }));
  }
}

function registered(names: readonly string[]): string {
  if (names.length === 0) return "No robot is registered yet: iort robots add NAME registers one.";
  const shown = [...names].sort(byName).slice(0, MOST_NAMES);
  return `Registered: ${shown.join(", ")}${names.length > shown.length ? ` and ${names.length - shown.length} more` : ""}.`;
}

const write = (id: string, text: string): void => setText(byId(id), text);
