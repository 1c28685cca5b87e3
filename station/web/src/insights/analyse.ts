// Starts an analysis in the cloud, and tells how far it is.

import type { AnalysisAnswer, AnalysisStarted } from "../base/contract";
import { choices, el, form } from "../base/dom";
import { act, ask, words } from "../server/answers";

const DAY_S = 86_400;
const RANGES = [
  [String(DAY_S), "last 1 day"],
  [String(7 * DAY_S), "last 7 days"],
  [String(30 * DAY_S), "last 30 days"],
] as const;
const POLL_MS = 1500;

export class Analyse {
  readonly node: HTMLElement;
  private readonly last = el("select", { "aria-label": "Drives of the last" }, ...choices(RANGES));
  private readonly button = el("button", { type: "submit", class: "tool" }, "Analyse");
  private robot: string | undefined;
  private run = "";
  private timer: number | undefined;

  /** `say` shows a text; `done` is called with the number of analysed drives. */
  constructor(
    private readonly say: (text: string) => void,
    private readonly done: (drives: number) => void,
  ) {
    this.node = form({ class: "range analyse" }, () => void this.start(), this.last, this.button);
  }

  /** Analyse the drives of this robot from now on; of all robots if undefined. */
  of(robot: string | undefined): void {
    if (robot !== this.robot) this.stop();
    this.robot = robot;
  }

  /** The analysis goes on without a viewer. */
  stop(): void {
    window.clearTimeout(this.timer);
    this.run = "";
    this.button.disabled = false;
  }

  private async start(): Promise<void> {
    const { robot } = this;
    this.button.disabled = true;
    this.say("Starting the analysis …");
    try {
      const { run } = await act<AnalysisStarted>("analyse", {
        last_s: this.last.value,
        ...(robot === undefined ? {} : { robot }),
      });
      if (robot !== this.robot) return;
      this.run = run;
      await this.look(run);
    } catch (error) {
      this.fail(error);
    }
  }

  private async look(run: string): Promise<void> {
    try {
      const { running, drives, done } = await ask<AnalysisAnswer>("analysis", { run });
      if (run !== this.run) return;
      if (running) {
        this.say(drives === null ? "Looking for drives …" : `${done} of ${drives} drives are analysed …`);
        this.timer = window.setTimeout(() => void this.look(run), POLL_MS);
        return;
      }
      this.stop();
      this.done(drives ?? 0);
    } catch (error) {
      this.fail(error);
    }
  }

  private fail(error: unknown): void {
    this.stop();
    this.say(words(error));
  }
}
