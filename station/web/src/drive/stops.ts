// The emergency stops of the fleet, as the page's server reads them from the cars' shadows.

import type { Config, MotionAnswer, MotionEntry } from "../base/contract";
import { may } from "../server/admission";
import { act, ask, AnswerError } from "../server/answers";

const POLL_MS = 10_000;
// While a car has not confirmed what was asked for here.
const SOON_MS = 1_000;
const SOON_FOR_MS = 20_000;

export class Stops {
  /** Why the newest request failed, for the viewer. */
  error = "";
  /** Whether the page's server has stopped to answer: what is known may be of the past. */
  away = false;
  /** Whether this browser may stop cars, and release them. */
  readonly able: boolean;
  /** Who drives, unless the viewer gives a name. */
  user = "";
  private robots: Readonly<Record<string, MotionEntry>> = {};
  private timer: number | undefined;
  private soonUntil_ms = 0;
  private answered = false;

  constructor(
    config: Config,
    private readonly changed: () => void,
  ) {
    this.able = may(config, "stop");
    if (!config.answers) return;
    document.addEventListener("visibilitychange", () => void this.poll());
    void this.poll();
  }

  of(robot: string): MotionEntry | undefined {
    return Object.hasOwn(this.robots, robot) ? this.robots[robot] : undefined;
  }

  /** The cars that stand until they are released, and those that have not confirmed a stop or a release. */
  get stopped(): { readonly stand: string[]; readonly pending: string[] } {
    const names = Object.keys(this.robots);
    const pending = names.filter((name) => waits(this.robots[name]!));
    return { stand: names.filter((name) => this.robots[name]!.stopped === true && !pending.includes(name)), pending };
  }

  /** The cars that a stop of the fleet holds, which the fleet's release ends; and those that were stopped alone. */
  get held(): { readonly fleet: string[]; readonly alone: string[] } {
    const asked = Object.keys(this.robots).filter((name) => this.robots[name]!.asked);
    return { fleet: asked.filter((name) => !this.robots[name]!.alone), alone: asked.filter((name) => this.robots[name]!.alone) };
  }

  /** When the newest stop of a car, or of any, was asked for. */
  newest_ms(robot: string | undefined): number {
    const robots = robot === undefined ? Object.values(this.robots).filter(({ asked }) => asked) : [this.of(robot)];
    return Math.max(0, ...robots.map((one) => one?.at_ms ?? 0));
  }

  /** Stop a car, or every one; or release it from the stops that the viewer knows of. */
  async set(robot: string | undefined, stopped: boolean, seen_ms = 0): Promise<void> {
    this.error = "";
    const whom = robot === undefined ? {} : { robot };
    try {
      const answer = await act<MotionAnswer>("stop", { stopped: String(stopped), ...whom, ...(stopped ? {} : { seen_ms: String(seen_ms) }) });
      this.take(answer);
      const failed = Object.entries(answer.failed).map(([name, reason]) => `${name}: ${reason}`);
      if (failed.length > 0) this.error = `Not ${stopped ? "stopped" : "released"}: ${failed.join("; ")}`;
    } catch (error) {
      if (!(error instanceof AnswerError)) throw error;
      this.error = `Not ${stopped ? "stopped" : "released"}: ${error.message}`;
    }
    this.soonUntil_ms = performance.now() + SOON_FOR_MS;
    this.changed();
    this.later(SOON_MS);
  }

  private async poll(): Promise<void> {
    window.clearTimeout(this.timer);
    if (document.hidden) return;
    try {
      this.take(await ask<MotionAnswer>("motion", {}));
      this.changed();
    } catch (error) {
      if (!(error instanceof AnswerError)) throw error;
      // What was known stays. A server that has never answered is an older one.
      this.away = this.answered;
      this.changed();
    }
    this.later(this.stopped.pending.length > 0 && performance.now() < this.soonUntil_ms ? SOON_MS : POLL_MS);
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

/** Whether a car has not done yet what was asked for; one that cannot move has nothing to do. */
const waits = ({ asked, stopped, reason }: MotionEntry): boolean => reason === "" && asked !== (stopped ?? false);
