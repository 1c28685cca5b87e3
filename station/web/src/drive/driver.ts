// A driver's hold of the stick, without the page: when the car may move, which commands go out, and why it is over.
//
// A hold begins at a standstill. It may move once the car has answered a command, within the limits of the round trip
// and of the newest sample's age. Whatever ends it, the viewer must let go before the next one: a car must not
// move because an obstacle to driving has gone away. Who has let go still has the wheel: the car is told to stand, so
// that no planner on board drives off, until the viewer leaves the wheel or loses it.
//
// A car with video is driven by sight: `new Driver(limits, by, newName, motion.video?.max_age_ms)`. Call
//   see(frame, age_ms, now_ms)  at each new picture on the screen: its number and its age at now_ms; both undefined once
//                               no picture is shown. The age grows by itself until the next call.
//   hide(hidden)                at each visibilitychange, and once at first.
//   blind = true                while the viewer says that he drives blind.
// Each command names the newest picture. Without one, with a late one or in a hidden tab nothing is sent but the end of
// the lease, also by who has let go: the car is lost as by a lease that ended. `unseen(now_ms)` says why.
//
// iort_station.fleet.driving does the same and draws the phases; tests/unit/station/fleet/driving.json tests both.

import {
  DRIVE_ANSWER_MS,
  DRIVE_CORRECTIONS,
  DRIVE_ENDS,
  DRIVE_LEASE_MS,
  DRIVE_MAX_AGE_MS,
  DRIVE_MAX_RTT_MS,
  type DriveLimitsEntry,
  LIVE_MAX_RATE_HZ,
} from "../base/contract";
import { CloudClock } from "./cloud_clock";
import { type Command, commandOf, leaseOf, type Session } from "./command";
import type { Driven, LiveMessage } from "./live_message";
import { inWords, lost, untimely } from "./outcomes";
import { CENTRE, type Motion, meant, type Stick } from "./stick";

export type Phase = "free" | "starting" | "driving" | "holding" | "over";

// Between two samples of the stream `drive`, at most, however slow the other streams are.
const SAMPLE_MS = 1000 / LIVE_MAX_RATE_HZ;
const STANDING: Motion = { speed_mps: 0, steering_rad: 0 };

export class Driver {
  phase: Phase = "free";
  /** Why the hold is over, or why none can begin; for the viewer. */
  reason = "";
  rtt_ms: number | undefined;
  /** Who drives instead, if that has ended the last hold: taking over may be offered. */
  other = "";
  /** The viewer's own top speed. */
  top_mps: number;
  stick: Stick = CENTRE;
  /** Whether the viewer says that he drives a car with video without its picture. */
  blind = false;
  private picture: { readonly frame: number; readonly taken_ms: number } | undefined;
  private hidden = false;
  private readonly clock = new CloudClock();
  private held = false;
  /** Whether the car is told to stand while nobody holds the stick. */
  private standing = false;
  private session: Session | undefined;
  private seq = 0;
  private began_ms = 0;
  private corrections = 0;
  private stops = 0;
  private takeover = false;
  private obstacle = "";
  private halted = false;
  private ticked_ms = Infinity;
  private taken_ms = -Infinity;
  private clockless = false;
  private newest: { readonly driven: Driven; readonly until_ms: number } | undefined;
  /** When each command left that the car has not answered, the oldest first. */
  private waiting: { readonly seq: number; readonly left_ms: number }[] = [];

  constructor(
    private readonly limits: DriveLimitsEntry,
    private readonly by: string,
    private readonly newName: () => string,
    /** How old a picture may be; undefined for a car without video. */
    private readonly maxPicture_ms?: number,
  ) {
    this.top_mps = limits.max_speed_mps;
  }

  /** The age of the car's newest sample; undefined before the first one. */
  age_ms(now_ms: number): number | undefined {
    const cloud = this.cloud_ms(now_ms);
    return cloud === undefined || this.taken_ms === -Infinity
      ? undefined
      : Math.max(0, cloud - this.taken_ms);
  }

  /** The newest picture on the screen, and its age when it got there; undefined once no picture is shown. */
  see(frame: number | undefined, age_ms: number | undefined, now_ms: number): void {
    this.picture =
      frame === undefined || age_ms === undefined ? undefined : { frame, taken_ms: now_ms - age_ms };
  }

  /** Whether the tab is hidden. */
  hide(hidden: boolean): void {
    this.hidden = hidden;
  }

  /** The age of the newest picture on the screen; undefined without one. */
  picture_ms(now_ms: number): number | undefined {
    return this.picture && Math.max(0, now_ms - this.picture.taken_ms);
  }

  /** Who drives now, by the car's own word: the name, and whether it is this hold. */
  driving(now_ms: number): { readonly by: string; readonly mine: boolean } | undefined {
    if (!this.newest || this.newest.driven.driver === "" || now_ms > this.newest.until_ms) return undefined;
    const { driver, driverBy } = this.newest.driven;
    return { by: driverBy || "somebody", mine: driver === this.session?.name };
  }

  /** Why the connection does not work; an empty text if it does. */
  block(obstacle: string): void {
    this.obstacle = obstacle;
    if (obstacle !== "") this.end(obstacle);
  }

  /** Whether an emergency stop is asked for. */
  halt(stopped: boolean): void {
    this.halted = stopped;
    if (stopped) this.end(inWords("emergency_stop"), true);
  }

  /** The viewer holds the dead-man button, or not. */
  hold(held: boolean, now_ms: number): void {
    if (held === this.held) return;
    this.held = held;
    if (!held) {
      if (!this.standing) this.finish();
      [this.phase, this.reason] = [this.standing ? "holding" : "free", ""];
      return;
    }
    [this.other, this.corrections] = ["", 0];
    const against = this.against(now_ms);
    if (against !== "") [this.phase, this.reason] = ["over", against];
    // The session has the car already.
    else if (this.standing) [this.phase, this.reason, this.began_ms] = ["starting", "", now_ms];
    else this.begin(now_ms);
  }

  /** The viewer leaves the wheel: others may drive. */
  leave(): void {
    this.held = false;
    this.finish();
    [this.phase, this.reason] = ["free", ""];
  }

  /** The next hold takes over from whoever drives. */
  askTakeover(): void {
    [this.takeover, this.other] = [true, ""];
  }

  hear(message: LiveMessage, now_ms: number): void {
    this.clockless = message.taken_ms === undefined;
    if (message.taken_ms !== undefined) {
      this.clock.heard(message.sent_ms!, now_ms);
      this.taken_ms = Math.max(this.taken_ms, message.taken_ms);
    }
    if (message.driven) this.answer(message.driven, message, now_ms);
  }

  /** The command to send now, if any. */
  tick(now_ms: number): Command | undefined {
    const still_ms = now_ms - this.ticked_ms;
    this.ticked_ms = now_ms;
    const unseen = this.unseen(now_ms);
    if (unseen !== "" && (this.standing || this.phase === "starting" || this.phase === "driving"))
      this.end(unseen, true);
    if (this.phase === "starting" || this.phase === "driving") {
      // A key may have been let go meanwhile.
      const frozen =
        still_ms > leaseOf(this.limits) ? `This page stood still for ${Math.round(still_ms)} ms` : "";
      const against = frozen || this.against(now_ms) || this.unanswered(now_ms);
      if (against !== "") this.end(against);
    }
    if (this.phase !== "driving" && (this.phase === "starting" || this.standing))
      return this.command(STANDING, now_ms);
    if (this.phase === "driving")
      return this.command(meant(this.stick, { top_mps: this.top_mps, ...this.limits }), now_ms);
    if (this.stops === 0) return undefined;
    this.stops -= 1;
    return this.command(STANDING, now_ms, true);
  }

  private begin(now_ms: number): void {
    this.session = { name: this.newName(), started_us: this.cloud_us(now_ms), by: this.by };
    [this.seq, this.waiting, this.stops, this.rtt_ms] = [0, [], 0, undefined];
    [this.phase, this.reason, this.began_ms] = ["starting", "", now_ms];
  }

  /** End the hold with a reason; the viewer must let go. A car that is lost to another or a stop is not held. */
  private end(reason: string, lost = false): void {
    const holds = this.phase === "starting" || this.phase === "driving";
    if (lost || !this.standing) this.finish();
    if (holds || (lost && this.phase !== "free"))
      [this.phase, this.reason] = [this.held ? "over" : "free", reason];
    this.takeover = false;
  }

  /** Give the car up, if the viewer may have it. */
  private finish(): void {
    if (this.standing || this.phase === "starting" || this.phase === "driving") this.stops = DRIVE_ENDS;
    [this.standing, this.takeover] = [false, false];
  }

  /** Why the car must not be driven now; an empty text if nothing is against it. */
  against(now_ms: number): string {
    if (this.obstacle !== "") return this.obstacle;
    if (this.halted) return inWords("emergency_stop");
    if (this.clockless) return inWords("clock_offset_unknown");
    const age = this.age_ms(now_ms);
    if (age === undefined) return "Nothing has been heard of the car yet";
    return age > DRIVE_MAX_AGE_MS
      ? `The newest sample is ${Math.round(age)} ms old, at most ${DRIVE_MAX_AGE_MS} ms is allowed`
      : this.unseen(now_ms);
  }

  /** Why the car must not be driven by its picture; an empty text if it may, has none, or is driven blind. */
  unseen(now_ms: number): string {
    if (this.maxPicture_ms === undefined || this.blind) return "";
    if (this.hidden) return "This tab is hidden: nobody sees the picture";
    const age = this.picture_ms(now_ms);
    if (age === undefined) return "No picture is on the screen";
    return age > this.maxPicture_ms
      ? `The picture is ${Math.round(age)} ms old, at most ${this.maxPicture_ms} ms is allowed`
      : "";
  }

  private unanswered(now_ms: number): string {
    if (this.phase === "starting")
      return now_ms - this.began_ms > DRIVE_ANSWER_MS ? "The car does not answer" : "";
    const oldest = this.waiting[0]?.left_ms ?? now_ms;
    return now_ms - oldest > DRIVE_MAX_RTT_MS + SAMPLE_MS
      ? `The car has not answered for ${Math.round(now_ms - oldest)} ms`
      : "";
  }

  private answer(driven: Driven, message: LiveMessage, now_ms: number): void {
    this.newest = { driven, until_ms: now_ms + driven.leaseLeft_ms };
    if (driven.session !== this.session?.name) {
      // Another's command has passed, so ours no longer do.
      if (this.standing && driven.driver !== "" && driven.driver !== this.session?.name) this.lose(driven);
      return;
    }
    const sent = this.waiting.find(({ seq }) => seq === driven.seq);
    this.waiting = this.waiting.filter(({ seq }) => seq > driven.seq);
    if (sent) {
      this.rtt_ms = Math.max(0, now_ms - sent.left_ms - message.lay_ms);
      if (message.taken_ms !== undefined) this.clock.answered(sent.left_ms, message.taken_ms);
    }
    const holds = this.phase === "starting" || this.phase === "driving";
    if (!holds && (!this.standing || driven.outcome === "stopped" || driven.outcome === "accepted")) return;
    if (driven.outcome !== "accepted") this.refused(driven, now_ms);
    else if (this.rtt_ms !== undefined && this.rtt_ms > DRIVE_MAX_RTT_MS) this.end(slow(this.rtt_ms));
    else if (this.phase === "starting") [this.phase, this.takeover, this.standing] = ["driving", false, true];
  }

  private refused(driven: Driven, now_ms: number): void {
    if (driven.outcome === "driven_by_another") {
      this.lose(driven);
    } else if (lost.has(driven.outcome)) {
      this.end(inWords(driven.outcome), true);
    } else if (this.phase === "holding") {
      // The next command may pass.
    } else if (
      this.phase === "starting" &&
      !this.standing &&
      untimely.has(driven.outcome) &&
      this.corrections < DRIVE_CORRECTIONS
    ) {
      this.corrections += 1;
      const { began_ms } = this;
      this.begin(now_ms);
      this.began_ms = began_ms;
    } else {
      this.end(inWords(driven.outcome));
    }
  }

  private lose(driven: Driven): void {
    this.other = driven.driverBy || "Somebody";
    this.end(`${this.other} ${this.standing ? "has taken over" : "drives this car"}`, true);
  }

  private command(motion: Motion, now_ms: number, ends = false): Command | undefined {
    if (!this.session) return undefined;
    const { seq } = this;
    this.seq += 1;
    this.waiting.push({ seq, left_ms: now_ms });
    this.waiting = this.waiting.filter(({ left_ms }) => now_ms - left_ms < DRIVE_ANSWER_MS + DRIVE_LEASE_MS);
    return commandOf(this.session, this.limits, {
      seq,
      sent_us: this.cloud_us(now_ms),
      motion,
      takeover: this.takeover,
      ends,
      ...this.sight(),
    });
  }

  /** What a command says of the picture; nothing to a car without video. */
  private sight(): { readonly frame: number | undefined; readonly blind: boolean } {
    return this.maxPicture_ms === undefined
      ? { frame: undefined, blind: false }
      : { frame: this.picture?.frame, blind: this.blind };
  }

  private cloud_ms(now_ms: number): number | undefined {
    return this.clock.offset_ms === undefined ? undefined : now_ms + this.clock.offset_ms;
  }

  private cloud_us(now_ms: number): number {
    return Math.round((this.cloud_ms(now_ms) ?? now_ms) * 1e3);
  }
}

const slow = (rtt_ms: number): string =>
  `The round trip takes ${Math.round(rtt_ms)} ms, at most ${DRIVE_MAX_RTT_MS} ms is allowed`;
