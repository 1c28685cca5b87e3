// The alarms: what is wrong, since when, what to do, where to look; and who has seen it.

import type { AlarmEntry, Rejected, RejectedAnswer } from "../base/contract";
import { button, el, marked, Text, table, unserved } from "../base/dom";
import { capital, when } from "../base/format";
import { keep, kept } from "../base/kept";
import { writeTime } from "../base/range";
import { route } from "../base/route";
import type { CarState, Raised } from "../live/alarms";
import { ask, words } from "../server/answers";
import { type Services, type View, viewNode } from "./view";

// The part of a car's past that a link shows. A cloud's alarm goes off minutes after its cause.
const BEFORE_S = 60;
const CLOUD_BEFORE_S = 300;
const AFTER_S = 60;
const UNSERVED =
  "This page was put on the web as it is: it sees only what the cars send. Run `iort dashboard` for the cloud's alarms.";
const STATES = { ALARM: "raised", INSUFFICIENT_DATA: "no data yet", OK: "quiet" } as const;

export class AlarmsView implements View {
  readonly node: HTMLElement;
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly name = el("input", {
    id: "acknowledge-as",
    name: "acknowledge-as",
    autocomplete: "name",
    maxlength: "64",
  });
  private readonly list = el("ul", { class: "raised" });
  private readonly none = el("p", { class: "unserved" }, "No alarm is raised.");
  private readonly quiet = el("tbody");
  private readonly count = new Text("count-quiet");
  private readonly cards = new Map<string, { readonly drawn: string; readonly node: HTMLElement }>();
  private rejected: RejectedAnswer | undefined;
  private rejectedAt = NaN;
  private quietDrawn: unknown;
  private failure = "";

  constructor(private readonly services: Services) {
    const { config } = services;
    this.name.value = kept("name") ?? "";
    this.name.addEventListener("change", () => keep("name", this.name.value));
    const head = ["Alarm", "Meaning", "State", "What to do"];
    const others = el(
      "details",
      { class: "panel quiet" },
      el("summary", {}, this.count.node),
      el("div", { class: "log" }, table(head, this.quiet)),
    );
    const named = el("p", { class: "range" }, el("label", {}, "acknowledge as ", this.name));
    this.node = viewNode(
      "alarms-view",
      "Alarms",
      [this.note.node],
      config.answers ? named : unserved(UNSERVED),
      this.none,
      this.list,
      ...(config.answers ? [others] : []),
    );
  }

  title(): string {
    return "Alarms · iort";
  }

  /** The alarms are the same, whatever the address says. */
  show(): void {}

  /** Update what changes; an alarm that has not changed keeps its node, and with it the focus. */
  clock(now: number): void {
    const { entries, error, askedAt, user } = this.services.alarms;
    this.name.placeholder = user;
    this.note.set(
      this.failure ||
        error ||
        (entries ? `as of ${when(askedAt)}` : this.services.config.answers ? "Loading …" : ""),
    );
    const raised = this.services.alarms.raised(now);
    if (raised.some(({ entry }) => entry?.evidence === "quarantine") && this.rejectedAt !== askedAt)
      void this.find(askedAt);
    this.none.hidden = raised.length > 0 || (this.services.config.answers && entries === undefined);
    const shown = raised.map((alarm) => this.card(alarm));
    if (shown.some((node, i) => this.list.children[i] !== node) || this.list.children.length !== shown.length)
      this.list.replaceChildren(...shown);
    for (const key of this.cards.keys())
      if (!raised.some((alarm) => alarm.key === key)) this.cards.delete(key);
    if (this.quietDrawn !== entries) {
      this.quietDrawn = entries;
      const others = (entries ?? []).filter(({ state }) => state !== "ALARM");
      this.count.set(`${others.length} ${others.length === 1 ? "alarm is" : "alarms are"} not raised`);
      this.quiet.replaceChildren(...others.map(row));
    }
  }

  private async find(askedAt: number): Promise<void> {
    this.rejectedAt = askedAt;
    try {
      this.rejected = await ask<RejectedAnswer>("rejected", {});
      this.failure = "";
    } catch (error) {
      this.failure = words(error);
    }
  }

  private card(alarm: Raised): HTMLElement {
    const messages = alarm.entry?.evidence === "quarantine" ? this.rejected : undefined;
    const drawn = JSON.stringify([alarm, messages]);
    const before = this.cards.get(alarm.key);
    if (before?.drawn === drawn) return before.node;
    const { key, meaning, advice, entry, cars, fresh } = alarm;
    const seen = entry?.acknowledged;
    const acknowledge = button("Acknowledge", () => entry && void this.acknowledge(entry, acknowledge));
    const since = entry?.state === "ALARM" ? `raised since ${when(entry.since_s)}` : "raised by live values";
    const beside = [el("code", { class: "note" }, key), el("span", { class: "note" }, since)];
    const node = el(
      "li",
      { class: "panel alarm", "data-alarm": key, "data-fresh": String(fresh) },
      el("header", {}, el("h3", {}, capital(meaning)), ...beside),
      el("p", {}, el("b", {}, "What to do: "), ...marked(advice)),
      ...(cars.length > 0 ? [el("ul", { class: "cases" }, ...cars.map(live))] : []),
      ...(entry?.state === "ALARM" ? evidence(entry, messages) : []),
      el(
        "p",
        { class: "seen" },
        ...(seen
          ? [`Acknowledged by ${seen.by}, ${when(seen.at_s)}.`, ...(fresh ? [" A car joined since."] : [])]
          : []),
        ...(entry?.state === "ALARM" && fresh ? [acknowledge] : []),
      ),
    );
    this.cards.set(key, { drawn, node });
    return node;
  }

  private async acknowledge(entry: AlarmEntry, button: HTMLButtonElement): Promise<void> {
    button.disabled = true;
    try {
      await this.services.alarms.acknowledge(entry, this.name.value);
      this.failure = "";
    } catch (error) {
      this.failure = words(error);
      button.disabled = false;
    }
  }
}

/** Where more is known about an alarm of the cloud. */
function evidence(
  { evidence, robots, named, since_s }: AlarmEntry,
  messages: RejectedAnswer | undefined,
): HTMLElement[] {
  if (evidence === "logs") {
    const link = el(
      "a",
      { class: "tool", href: route({ view: "cloudwatch" }) },
      "Newest warnings and errors",
    );
    return [el("p", {}, link)];
  }
  if (evidence === "quarantine") {
    if (!messages) return [];
    const { rejected, found } = messages;
    const told =
      found === 0
        ? "Nothing is in quarantine now."
        : found > rejected.length
          ? `The newest ${rejected.length} of ${found} messages in quarantine:`
          : "In quarantine:";
    return [el("p", {}, told), el("ul", { class: "cases" }, ...rejected.map(message))];
  }
  if (robots.length === 0) return [];
  const links = robots.map((robot) =>
    el("li", {}, past(robot, since_s - CLOUD_BEFORE_S, since_s + AFTER_S, robot)),
  );
  const which = named ? "that an alert has named" : "that were connected";
  return [el("p", {}, `The cars ${which}, at that time:`), el("ul", { class: "cases across" }, ...links)];
}

function live({ robot, text, since }: CarState): HTMLElement {
  return el(
    "li",
    {},
    el("a", { class: "tool", href: route({ view: "car", robot }) }, robot),
    el("b", {}, text),
    ` since ${when(since)} `,
    past(robot, since - BEFORE_S, since + AFTER_S, "That moment"),
  );
}

function message({ id, robot, topic, source, reason, last_s, seen }: Rejected): HTMLElement {
  const at = `${when(last_s)}${seen > 1 ? `, ${seen} times` : ""}`;
  return el(
    "li",
    {},
    robot === "-"
      ? el("span", { class: "note" }, at)
      : past(robot, last_s - BEFORE_S, last_s + AFTER_S, `${robot}, ${at}`),
    el("span", {}, reason),
    el("span", { class: "note" }, `${source} ${topic}`),
    el("code", {}, `iort errors ${id}`),
  );
}

/** A link to a car's past. */
function past(robot: string, from_s: number, to_s: number, text: string): HTMLElement {
  const query = { from: writeTime(from_s), to: writeTime(to_s) };
  return el("a", { class: "tool", href: route({ view: "history", robot, query }) }, text);
}

function row({ key, meaning, state, since_s, advice }: AlarmEntry): HTMLElement {
  return el(
    "tr",
    {},
    el("td", {}, el("code", {}, key)),
    el("td", { class: "words" }, meaning),
    el("td", {}, `${STATES[state]} since ${when(since_s)}`),
    el("td", { class: "words" }, ...marked(advice)),
  );
}
