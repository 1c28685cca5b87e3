// The registered cars that this page has not heard: since when they are offline, and a link to their past.

import type { Config, RobotPresence, RobotsAnswer } from "../base/contract";
import { ask, AnswerError } from "../server/answers";
import { byName, el } from "../base/dom";
import type { Fleet } from "../live/fleet";
import { dayTime, zone } from "../base/format";
import { route } from "../base/route";

const REFRESH_S = 30;

export class AbsentCars {
  readonly node = el("section", { class: "absent", "aria-label": "Cars that are not heard", hidden: "" });
  private robots: RobotsAnswer["robots"] = {};
  private drawn = "";
  private timer: number | undefined;

  constructor(
    private readonly config: Config,
    private readonly fleet: Fleet,
  ) {}

  /** Ask while the view is shown; a page without a server knows only the cars that it hears. */
  show(shown: boolean): void {
    window.clearInterval(this.timer);
    if (!shown || !this.config.answers) return;
    void this.find();
    this.timer = window.setInterval(() => !document.hidden && void this.find(), REFRESH_S * 1000);
  }

  /** List the registered cars that are not heard. */
  arrange(): void {
    const away = Object.keys(this.robots).filter((name) => !this.fleet.robots.has(name)).sort(byName);
    const rows = away.map((name) => [name, state(this.robots[name]!)] as const);
    const drawn = JSON.stringify(rows);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.node.hidden = rows.length === 0;
    this.node.replaceChildren(
      el("h2", {}, "Registered, and not heard since this page was opened"),
      el("ul", {}, ...rows.map(([name, text]) => el("li", { "data-absent": name }, el("a", { href: route({ view: "history", robot: name }), title: `What ${name} did` }, name), " ", text))),
    );
  }

  private async find(): Promise<void> {
    try {
      this.robots = (await ask<RobotsAnswer>("robots", {})).robots;
      this.arrange();
    } catch (error) {
      // The list stays as it was; other views report that the server does not answer.
      if (!(error instanceof AnswerError)) throw error;
    }
  }
}

function state({ online, since_ms }: RobotPresence): string {
  if (online) return "connected, and sends nothing live";
  if (since_ms === null) return "never connected";
  return `offline since ${dayTime(since_ms / 1000)} ${zone(since_ms / 1000)}`;
}
