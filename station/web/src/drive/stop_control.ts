// The emergency stop above every view: of the car that is shown, and else of the fleet. A press stops; only a release
// asks whether it is meant. Below it is what the cars say: which stand, which do not although they were to, and, before
// anybody needs it, which cannot be stopped.

import type { Config } from "../base/contract";
import { byId, el, onPress, setAttribute, Text } from "../base/dom";
import { age, when } from "../base/format";
import { ANSWER_MS, Stops } from "./stops";

// A longer list of names says nothing more.
const NAMED = 6;

export class StopControl {
  readonly stops: Stops;
  private readonly press = el("button", { type: "button", class: "stop-press" });
  private readonly sent = new Text("stop-sent", "p", { role: "status" });
  private readonly moves = new Text("stop-moves", "p", { role: "alert" });
  private readonly words = new Text("stop-words", "p", { role: "status" });
  private readonly unable = new Text("stop-unable", "p");
  private readonly release = el("button", { type: "button", class: "tool stop-release" });
  private readonly stands = el("div", { class: "stop-stands" }, this.words.node, this.release);
  private robot: string | undefined;
  private sure = false;
  // The newest stop when the viewer was asked whether to release it.
  private seen_ms = 0;

  /** `online` as in `Stops`; `changed` is called when the cars' stops or limits may be others. */
  constructor(config: Config, online: (robot: string) => boolean | undefined, changed: () => void) {
    this.stops = new Stops(config, online, () => {
      this.show();
      changed();
    });
    const strip = el("div", { class: "stop-strip" }, this.sent.node, this.moves.node, this.stands);
    const header = byId("top");
    header.after(strip);
    // It is read before it is needed, and takes no room later.
    byId("over").after(this.unable.node);
    // What stays in sight while the page scrolls covers what is below it.
    const measured = [
      [header, "--header"],
      [strip, "--strip"],
    ] as const;
    const observer = new ResizeObserver(() =>
      measured.forEach(([node, name]) =>
        document.documentElement.style.setProperty(name, `${node.offsetHeight}px`),
      ),
    );
    for (const [node] of measured) observer.observe(node);
    this.press.hidden = !this.stops.able;
    if (this.stops.able) byId("stop-bar").append(this.press);
    this.press.addEventListener("click", () => void this.stops.set(this.robot, true));
    onPress(this.release, () => {
      if (this.sure) void this.stops.set(this.robot, false, this.seen_ms);
      this.ask(!this.sure);
    });
    this.release.addEventListener("blur", () => this.ask(false));
    this.of(undefined);
  }

  /** The buttons are about this car from now on; about the fleet if undefined. */
  of(robot: string | undefined): void {
    this.robot = robot;
    this.press.textContent = robot === undefined ? "Stop all" : `Stop ${robot}`;
    setAttribute(this.press, "aria-label", `${this.press.textContent}: emergency stop`);
    this.ask(false);
    this.show();
  }

  private ask(sure: boolean): void {
    this.sure = sure;
    this.seen_ms = this.stops.newest_ms(this.robot);
    const whom = this.robot === undefined ? this.stops.held.fleet : [this.robot];
    this.release.textContent = sure
      ? `Really release ${listed(whom)}: ${whom.length === 1 ? "it" : "they"} may move`
      : `Release ${this.robot ?? "all"}`;
    setAttribute(this.release, "data-sure", String(sure));
  }

  private show(): void {
    const { stops, robot } = this;
    const words = stops.names.map((name) => [name, stops.word(name)] as const);
    const of = (kind: string): (readonly [string, string])[] =>
      words.flatMap(([name, word]) => (word.kind === kind ? [[name, word.why] as const] : []));
    const stand = of("stands").map(([name]) => name);
    const released = stand.filter((name) => !stops.of(name)!.asked && stops.of(name)!.reason === "");
    const { fleet, alone } = stops.held;
    const one = robot === undefined ? undefined : stops.of(robot);
    write(this.sent, this.request());
    write(this.moves, reasons("NOT standing", of("moves")));
    write(
      this.words,
      [
        ...(stand.length > 0
          ? [`Emergency stop: ${listed(stand)} ${stand.length === 1 ? "stands" : "stand"}.`]
          : []),
        ...(released.length > 0 ? [`Release not confirmed by ${listed(released)}.`] : []),
        ...(one?.asked && one.by
          ? [`Stopped by ${one.by}, ${when(one.at_ms / 1000)}${one.alone ? "" : ", with the fleet"}.`]
          : []),
        ...(robot === undefined && alone.length > 0
          ? [`Stopped alone: ${listed(alone)}, to be released on the car's page.`]
          : []),
        ...(one?.stands && one.reason ? [`${robot} rejects the release: ${one.reason}.`] : []),
      ].join(" "),
    );
    write(
      this.unable,
      reasons(
        "The stop does not stop",
        of("unable").filter(([name]) => (robot ?? name) === name),
      ),
    );
    const any =
      robot === undefined ? fleet.length > 0 : one !== undefined && (one.asked || one.stopped === true);
    this.release.hidden = !stops.able || !any;
    this.stands.hidden = this.words.node.hidden && this.release.hidden;
  }

  /** What became of the newest press, and what else there is to do. */
  private request(): string {
    const { sent, error, away } = this.stops;
    const whom = sent?.robot ?? "all cars";
    if (sent && !sent.late) return `${sent.stopped ? "Stop" : "Release"} sent to ${whom} …`;
    if (sent)
      return sent.stopped
        ? `No answer after ${age(ANSWER_MS / 1000)}: ${whom} may not have been stopped. ${this.advice()}`
        : `No answer after ${age(ANSWER_MS / 1000)}: ${whom} may or may not have been released.`;
    if (error)
      return `${error}${error.endsWith(".") ? "" : "."}${error.startsWith("Not") ? "" : ` ${this.advice()}`}`;
    return away
      ? `The page's server does not answer: nobody can be stopped here, and cars may stand or move by now. ${this.advice()}`
      : "";
  }

  private advice(): string {
    const leases = this.stops.names.flatMap((name) => this.stops.of(name)!.drive?.lease_ms ?? []);
    const within = leases.length > 0 ? `, within ${age(Math.max(...leases) / 1000)} of the last one` : "";
    return `Press again, and use the switch on the car. By itself ends only what nobody renews: a command with its lease${within}. A planner on board drives on.`;
  }
}

function write(text: Text, words: string): void {
  text.set(words);
  text.node.hidden = words === "";
}

/** Names with their reasons: those with the same one together. */
function reasons(title: string, of: readonly (readonly [string, string])[]): string {
  const groups = [...new Set(of.map(([, why]) => why))].map(
    (why) => `${listed(of.flatMap(([name, its]) => (its === why ? [name] : [])))} (${why})`,
  );
  return groups.length > 0 ? `${title}: ${groups.join("; ")}.` : "";
}

function listed(names: readonly string[]): string {
  const more = names.length - NAMED;
  return names.slice(0, NAMED).join(", ") + (more > 0 ? ` and ${more} more` : "");
}
