// The emergency stop above every view: of the car that is shown, and else of the fleet. A press stops; only a release
// asks whether it is meant.

import type { Config } from "../base/contract";
import { el, onPress, setAttribute, Text } from "../base/dom";
import { when } from "../base/format";
import { Stops } from "./stops";

// A longer list of names says nothing more.
const NAMED = 6;

export class StopControl {
  readonly stops: Stops;
  private readonly press = el("button", { type: "button", class: "stop-press" });
  private readonly words = new Text("stop-words", "p", { role: "status" });
  private readonly release = el("button", { type: "button", class: "tool stop-release" });
  private readonly strip: HTMLElement;
  private robot: string | undefined;
  private sure = false;
  // The newest stop when the viewer was asked whether to release it.
  private seen_ms = 0;

  /** `changed` is called when the cars' stops or limits may be others. */
  constructor(config: Config, header: HTMLElement, changed: () => void) {
    this.stops = new Stops(config, () => {
      this.show();
      changed();
    });
    this.strip = el("div", { class: "stop-strip", hidden: "" }, this.words.node, this.release);
    header.after(this.strip);
    this.press.hidden = this.release.hidden = !this.stops.able;
    if (this.stops.able) header.querySelector("#link")!.before(this.press);
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
    this.release.textContent = sure ? `Really release ${listed(whom)}: ${whom.length === 1 ? "it" : "they"} may move` : `Release ${this.robot ?? "all"}`;
    setAttribute(this.release, "data-sure", String(sure));
  }

  private show(): void {
    const { stand, pending } = this.stops.stopped;
    const { fleet, alone } = this.stops.held;
    const one = this.robot === undefined ? undefined : this.stops.of(this.robot);
    const texts = [
      ...(stand.length > 0 ? [`Emergency stop: ${listed(stand)} ${stand.length === 1 ? "stands" : "stand"}.`] : []),
      ...(pending.length > 0 ? [`Not confirmed by ${listed(pending)}.`] : []),
      ...(one?.asked && one.by ? [`Stopped by ${one.by}, ${when(one.at_ms / 1000)}${one.alone ? "" : ", with the fleet"}.`] : []),
      ...(this.robot === undefined && alone.length > 0 ? [`Stopped alone: ${listed(alone)}, to be released on the car's page.`] : []),
      ...(one?.reason ? [`${this.robot} rejects the ${one.asked ? "stop" : "release"}: ${one.reason}.`] : []),
      ...(this.stops.error ? [`${this.stops.error}.`] : []),
      ...(this.stops.away ? ["The page's server does not answer: nobody can be stopped here, and cars may stand or move by now."] : []),
    ];
    this.words.set(texts.join(" "));
    this.strip.hidden = texts.length === 0;
    setAttribute(this.strip, "data-bad", String(pending.length > 0 || this.stops.error !== "" || this.stops.away));
    const any = this.robot === undefined ? fleet.length > 0 : one !== undefined && (one.asked || one.stopped === true);
    this.release.hidden = !this.stops.able || !any;
  }
}

function listed(names: readonly string[]): string {
  const more = names.length - NAMED;
  return names.slice(0, NAMED).join(", ") + (more > 0 ? ` and ${more} more` : "");
}
