// The emergency stops of the fleet, as the page's server reads them from the cars' shadows.

import type { Config, MotionAnswer, MotionEntry } from "../base/contract";
import { may } from "../server/admission";
import { AnswerError, act, ask } from "../server/answers";

const POLL_MS = 10_000;
// While a car has not confirmed what was asked for here: often for the first seconds, and then for a while.
const [OFTEN_MS, OFTEN_FOR_MS] = [100, 3_000];
const [SOON_MS, SOON_FOR_MS] = [1_000, 20_000];
/** The viewer does not wait for the server's answer for longer than this. */
export const ANSWER_MS = 1_000;

/** The newest stop or release that was sent from here, until it is answered. */
interface Sent {
  readonly robot: string | undefined;
  readonly stopped: boolean;
  readonly end: AbortController;
  late: boolean;
}

/** What a stop means for a car: it stands, it does not although it was to, none can stop it, or nothing was asked for. */
export interface Word {
  readonly kind: "stands" | "moves" | "unable" | "";
  /** Why it does not stand, or cannot be stopped. */
  readonly why: string;
}

export class Stops {
  /** Why the newest request failed, for the viewer. */
  error = "";
  /** Whether the page's server has stopped to answer: what is known may be of the past. */
  away = false;
  /** Whether this browser may stop cars, and release them. */
  readonly able: boolean;
  /** Who drives, unless the viewer gives a name. */
  user = "";
  sent: Sent | undefined;
  private robots: Readonly<Record<string, MotionEntry>> = {};
  /** The cars whose stop, asked for here, could not be changed. */
  private failed: Readonly<Record<string, string>> = {};
  private timer: number | undefined;
  private sent_ms = -Infinity;
  private answered = false;
  /** Grows when a stop or a release is sent or answered: what was asked before says nothing any more. */
  private turn = 0;

  /** `online` tells whether a car is connected, undefined if it is not known. */
  constructor(
    config: Config,
    private readonly online: (robot: string) => boolean | undefined,
    private readonly changed: () => void,
  ) {
    this.able = may(config, "stop");
    if (!config.answers) return;
    document.addEventListener("visibilitychange", () => void this.poll());
    void this.poll();
  }

  /** What is known of a car; a stop that was sent counts as asked for, so that nobody here drives on. */
  of(robot: string): MotionEntry | undefined {
    const motion = Object.hasOwn(this.robots, robot) ? this.robots[robot] : undefined;
    return motion && this.sent?.stopped && (this.sent.robot ?? robot) === robot
      ? { ...motion, asked: true }
      : motion;
  }

  get names(): string[] {
    return Object.keys(this.robots);
  }

  word(robot: string): Word {
    const motion = this.of(robot);
    if (!motion) return { kind: "", why: "" };
    const { asked, stands, reason, stoppable, why_not } = motion;
    if (stands) return { kind: "stands", why: "" };
    const failed = Object.hasOwn(this.failed, robot) ? this.failed[robot]! : "";
    const why = failed
      ? `not sent: ${failed}`
      : reason
        ? stoppable === false
          ? why_not
          : `it rejects the stop: ${reason}`
        : asked
          ? this.online(robot) === false
            ? "offline: it has not confirmed it, and stops before it takes a command"
            : "not confirmed"
          : "";
    if (why) return { kind: "moves", why };
    if (stoppable === false) return { kind: "unable", why: why_not };
    return this.held.fleet.length > 0
      ? { kind: "moves", why: motion.by ? `released by ${motion.by}` : "it was not asked to stop" }
      : { kind: "", why: "" };
  }

  /** The cars that a stop of the fleet holds, which the fleet's release ends; and those that were stopped alone. */
  get held(): { readonly fleet: string[]; readonly alone: string[] } {
    const asked = this.names.filter((name) => this.robots[name]!.asked);
    return {
      fleet: asked.filter((name) => !this.robots[name]!.alone),
      alone: asked.filter((name) => this.robots[name]!.alone),
    };
  }

  /** When the newest stop of a car, or of any, was asked for. */
  newest_ms(robot: string | undefined): number {
    const robots =
      robot === undefined ? Object.values(this.robots).filter(({ asked }) => asked) : [this.of(robot)];
    return Math.max(0, ...robots.map((one) => one?.at_ms ?? 0));
  }

  /** Stop a car, or every one; or release it from the stops that the viewer knows of. */
  async set(robot: string | undefined, stopped: boolean, seen_ms = 0): Promise<void> {
    const before = this.sent;
    // The same again is under way. After a second, it may have been lost.
    if (before && !before.late && before.robot === robot && before.stopped === stopped) return;
    const sent: Sent = (this.sent = { robot, stopped, end: new AbortController(), late: false });
    [this.error, this.failed, this.sent_ms] = ["", {}, performance.now()];
    this.turn += 1;
    window.clearTimeout(this.timer);
    const whom = robot === undefined ? {} : { robot };
    const request = act<MotionAnswer>(
      "stop",
      { stopped: String(stopped), ...whom, ...(stopped ? {} : { seen_ms: String(seen_ms) }) },
      { signal: sent.end.signal },
    );
    // It holds a connection; the server works on it all the same.
    if (before?.late) before.end.abort();
    const late = window.setTimeout(() => {
      sent.late = true;
      this.changed();
      // What became of it can be read elsewhere.
      this.later(0);
    }, ANSWER_MS);
    this.changed();
    try {
      const answer = await request;
      this.turn += 1;
      this.take(answer);
      if (sent === this.sent && stopped) this.failed = answer.failed;
      const failed = Object.entries(answer.failed).map(([name, reason]) => `${name}: ${reason}`);
      if (failed.length > 0 && !stopped) this.error = `Not released: ${failed.join("; ")}`;
    } catch (error) {
      if (sent.end.signal.aborted) return;
      if (!(error instanceof AnswerError)) throw error;
      if (sent === this.sent)
        this.error = `${stopped ? "NOTHING WAS STOPPED" : "Not released"}: ${error.message}`;
    } finally {
      window.clearTimeout(late);
      if (sent === this.sent) this.sent = undefined;
    }
    this.changed();
    this.later(OFTEN_MS);
  }

  private async poll(): Promise<void> {
    window.clearTimeout(this.timer);
    if (document.hidden) return;
    const { turn } = this;
    try {
      const answer = await ask<MotionAnswer>("motion", {});
      if (turn === this.turn) this.take(answer);
      this.changed();
    } catch (error) {
      if (!(error instanceof AnswerError)) throw error;
      // What was known stays. A server that has never answered is an older one.
      this.away = this.answered;
      this.changed();
    }
    // Whatever was sent meanwhile asks again when it is answered.
    if (this.sent && !this.sent.late) return;
    const since_ms = performance.now() - this.sent_ms;
    const waits = Object.values(this.robots).some(
      ({ asked, stands, reason }) => reason === "" && asked !== stands,
    );
    this.later(!waits || since_ms > SOON_FOR_MS ? POLL_MS : since_ms > OFTEN_FOR_MS ? SOON_MS : OFTEN_MS);
  }

  private later(wait_ms: number): void {
    window.clearTimeout(this.timer);
    this.timer = window.setTimeout(() => void this.poll(), wait_ms);
  }

  private take({ robots, user }: MotionAnswer): void {
    this.robots = { ...this.robots, ...robots };
    this.user = user;
    [this.answered, this.away] = [true, false];
  }
}
