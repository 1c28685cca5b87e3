// Driving a car by hand, in its view: the stick, the dead-man's button, and what stands against driving.

import { now } from "../base/clock";
import {
  type Config,
  DRIVE_MAX_AGE_MS,
  DRIVE_MAX_RTT_MS,
  DRIVE_RATE_HZ,
  type DriveLimitsEntry,
} from "../base/contract";
import { button, el, newName, onPress, panel, setAttribute, setText, Text } from "../base/dom";
import { capital, NOTHING, number } from "../base/format";
import { keep, kept } from "../base/kept";
import { may } from "../server/admission";
import type { PicturePanel } from "../video/panel";
import { driverName } from "./command";
import { Driver } from "./driver";
import { Inputs } from "./inputs";
import { readLive } from "./live_message";
import { DriveSocket } from "./socket";
import { CENTRE, meant } from "./stick";
import type { Stops } from "./stops";

const FIRST_TOP_MPS = 0.5;
const TICK_S = 1 / DRIVE_RATE_HZ;
const WORDS = {
  free: "You have the wheel, and do not drive: whoever drives the car goes on. Hold the dead-man's switch to drive.",
  starting: "Waiting for the car's answer …",
  driving: "Driving.",
  holding:
    "You hold the car: it stands until you drive on, or leave the wheel. Then others may drive it, also a planner on board.",
} as const;
const STICK = "Stick: up is ahead";
const HELP =
  "Keys: hold Space, steer with the arrows or WASD, Escape leaves. Gamepad: hold L1 or R1. Mouse: drag the stick. Touch: hold the button, and move the stick. Letting go stops the car, and it stands until you leave the wheel.";
const BLIND = "Drive blind: without the picture. The car records it with every command.";
const UNHEARD = "The car does not hear you: others may drive it, also a planner on board.";

/** What a viewer has while at the wheel. */
interface Wheel {
  readonly driver: Driver;
  readonly inputs: Inputs;
  readonly socket: DriveSocket;
  readonly limits: DriveLimitsEntry;
  readonly timer: number;
}

export class DrivePanel {
  readonly node: HTMLElement;
  private readonly take = button("Take the wheel", () => this.enter(), { class: "tool primary" });
  private readonly leave = button("Leave the wheel", () => this.exit());
  private readonly over = button("", undefined, { hidden: "" });
  private readonly who = new Text("note");
  private readonly said = el("p", { class: "drive-said", role: "status" });
  private readonly knob = el("span", { class: "knob" });
  private readonly pad = el("div", { class: "stick", role: "img", "aria-label": STICK }, this.knob);
  private readonly hold = button("Hold to drive", undefined, { class: "deadman" });
  private readonly top = el("input", { type: "range", name: "top", min: "0.1", step: "0.1" });
  private readonly topWords = new Text("num");
  private readonly name = el("input", {
    type: "text",
    name: "driver",
    maxlength: "64",
    autocomplete: "name",
  });
  // Off for every wheel that is taken, and never kept.
  private readonly blind = el("input", { type: "checkbox", name: "blind" });
  private readonly blindly = el("label", { class: "drive-blind" }, this.blind, BLIND);
  private readonly figures = {
    rtt: figure("Round trip"),
    age: figure("Newest sample"),
    asked: figure("Asked for"),
  };
  private readonly body: HTMLElement;
  private robot: string | undefined;
  private wheel: Wheel | undefined;
  private read_s = 0;
  private sure = false;

  constructor(
    private readonly config: Config,
    private readonly stops: Stops,
    private readonly picture: PicturePanel,
  ) {
    this.name.value = kept("name") ?? "";
    this.name.addEventListener("change", () => keep("name", this.name.value));
    onPress(this.over, () => this.takeOver());
    this.over.addEventListener("blur", () => (this.sure = false));
    this.top.addEventListener("input", () => this.topped());
    // The next Space drives, and does not uncheck it.
    this.blind.addEventListener("change", () => this.hold.focus({ preventScroll: true }));
    const limits = el(
      "div",
      { class: "drive-limits" },
      el("label", {}, el("span", {}, "Top speed ", this.topWords.node), this.top),
      this.blindly,
      ...Object.values(this.figures).map(({ node }) => node),
    );
    const help = el("p", { class: "note drive-help" }, HELP);
    this.body = el("div", { class: "drive-body", hidden: "" }, this.pad, this.hold, limits, help);
    const named = el("label", { class: "drive-name" }, "as ", this.name);
    const beside = [this.who.node, named, this.take, this.leave];
    this.node = panel("Drive", "drive", beside, this.said, this.over, this.body);
    this.node.hidden = true;
    this.leave.hidden = true;
  }

  /** Drive this car from now on; none if undefined. */
  of(robot: string | undefined): void {
    if (robot === this.robot) return;
    this.exit();
    this.robot = robot;
    this.show();
  }

  /** Called when the cars' limits or their emergency stops may be others. */
  show(): void {
    const motion = this.robot === undefined ? undefined : this.stops.of(this.robot);
    this.node.hidden = !this.config.drivers || !may(this.config, "drive") || (!motion?.drive && !this.wheel);
    this.name.placeholder = this.stops.user;
    if (!this.wheel) this.say("");
  }

  /** Who drives, as the car tells everybody. */
  driven(by: string | undefined): void {
    if (!this.wheel) this.who.set(by === undefined ? "" : `${by} drives`);
  }

  private enter(): void {
    const { robot } = this;
    const motion = robot === undefined ? undefined : this.stops.of(robot);
    if (robot === undefined || !motion?.drive) return;
    const limits = motion.drive;
    const by = driverName(this.name.value, this.stops.user);
    const { video } = motion;
    const driver = new Driver(limits, by, newName, video?.max_age_ms);
    [this.blind.checked, this.blindly.hidden] = [false, !video];
    if (video) this.picture.open();
    this.top.max = String(limits.max_speed_mps);
    this.top.value = String(Math.min(limits.max_speed_mps, Number(kept("drive.top") ?? FIRST_TOP_MPS)));
    const inputs = new Inputs(
      this.pad,
      this.hold,
      () => this.held(),
      () => this.exit(),
    );
    const socket = new DriveSocket(
      this.config.namespace,
      robot,
      (topic, payload) => {
        const message = readLive(topic, payload);
        if (message) driver.hear(message, now() * 1000);
      },
      (reason) => driver.block(reason),
    );
    driver.block("Connecting …");
    const timer = window.setInterval(() => this.tick(), TICK_S * 1000);
    this.wheel = { driver, inputs, socket, limits, timer };
    this.topped();
    this.arranged();
    this.hold.focus({ preventScroll: true });
    if (video) this.picture.reveal();
  }

  private exit(): void {
    const { wheel } = this;
    if (!wheel) return;
    wheel.inputs.end();
    window.clearInterval(wheel.timer);
    wheel.driver.leave();
    // That others may drive.
    for (let command = wheel.driver.tick(now() * 1000); command; command = wheel.driver.tick(now() * 1000))
      wheel.socket.send(wheel.limits.command, command);
    wheel.socket.close();
    this.wheel = undefined;
    this.picture.meaning = "";
    this.who.set("");
    this.over.hidden = true;
    this.arranged();
    this.say("");
    this.show();
  }

  private arranged(): void {
    const on = this.wheel !== undefined;
    [this.take.hidden, this.leave.hidden, this.body.hidden, this.name.disabled] = [on, !on, !on, on];
    setAttribute(this.node, "data-on", String(on));
  }

  private held(): void {
    const { wheel } = this;
    if (!wheel) return;
    const { held } = wheel.inputs;
    if (held && document.hidden) return;
    setAttribute(this.hold, "data-held", String(held));
    wheel.driver.hold(held, now() * 1000);
    // A press and a release go out at once.
    this.tick();
  }

  private tick(): void {
    const { wheel } = this;
    if (!wheel) return;
    const at = now();
    const { driver, inputs, socket, limits } = wheel;
    const before = inputs.held;
    driver.stick = inputs.read(Math.min(at - this.read_s, 2 * TICK_S));
    this.read_s = at;
    // Only a gamepad's button is read here.
    if (inputs.held !== before) driver.hold(inputs.held, at * 1000);
    driver.halt(this.stops.of(this.robot!)?.asked === true);
    driver.blind = this.blind.checked;
    driver.hide(document.hidden);
    const seen = this.picture.seen();
    driver.see(seen?.number, seen?.age_ms, at * 1000);
    this.picture.meaning = driver.blind ? "you drive blind" : "driving has ended";
    const command = driver.tick(at * 1000);
    if (command) socket.send(limits.command, command);
    this.draw(at * 1000);
  }

  private draw(at_ms: number): void {
    const { driver, limits } = this.wheel!;
    const { stick, phase } = driver;
    this.knob.style.setProperty("--x", String(stick.x));
    this.knob.style.setProperty("--y", String(-stick.y));
    setAttribute(this.node, "data-phase", phase);
    const age = driver.age_ms(at_ms);
    this.figures.rtt.set(driver.rtt_ms, DRIVE_MAX_RTT_MS, "ms");
    this.figures.age.set(age, DRIVE_MAX_AGE_MS, "ms");
    const motion = meant(phase === "driving" ? stick : CENTRE, { top_mps: driver.top_mps, ...limits });
    this.figures.asked.text(`${number(motion.speed_mps, 1)} m/s, ${number(motion.steering_rad, 2)} rad`);
    const who = driver.driving(at_ms);
    this.who.set(who ? (who.mine ? "you drive" : `${who.by} drives`) : "nobody drives");
    const against = phase === "free" ? driver.against(at_ms) : "";
    const free =
      against ||
      (phase === "free" && driver.reason
        ? sentence(driver.reason)
        : WORDS[phase === "over" ? "free" : phase]);
    const unheard = phase === "holding" && !who?.mine;
    this.say(
      phase === "over" ? `${sentence(driver.reason)} Let go to begin again.` : unheard ? UNHEARD : free,
    );
    this.over.hidden = driver.other === "";
    if (!this.sure) this.over.textContent = `Take over from ${driver.other}`;
  }

  private takeOver(): void {
    if (!this.wheel) return;
    if (!this.sure) {
      this.sure = true;
      this.over.textContent = "Really take over? The other driver is told.";
      return;
    }
    this.sure = false;
    this.wheel.driver.askTakeover();
    this.over.hidden = true;
  }

  private topped(): void {
    keep("drive.top", this.top.value);
    this.topWords.set(`${number(this.top.valueAsNumber, 1)} m/s`);
    if (this.wheel) this.wheel.driver.top_mps = this.top.valueAsNumber;
  }

  private say(text: string): void {
    setText(this.said, capital(text));
  }
}

const sentence = (reason: string): string => (/[.…]$/.test(reason) ? reason : `${reason}.`);

/** A figure with its limit, marked when it is beyond. */
function figure(label: string): {
  readonly node: HTMLElement;
  readonly text: (text: string) => void;
  readonly set: (value: number | undefined, most: number, unit: string) => void;
} {
  const value = new Text("num");
  const limit = new Text("note");
  const name = el("span", { class: "label" }, label);
  const node = el("p", { class: "drive-figure" }, name, value.node, limit.node);
  return {
    node,
    text: (text) => value.set(text),
    set: (measured, most, unit) => {
      value.set(measured === undefined ? NOTHING : `${number(measured, 0)} ${unit}`);
      limit.set(`at most ${most} ${unit}`);
      setAttribute(node, "data-bad", String(measured !== undefined && measured > most));
    },
  };
}
