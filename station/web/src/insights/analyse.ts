// Starts an analysis in the cloud, and tells how far it is.

import type { AnalysisAnswer, AnalysisStarted } from "../base/contract";
import { el } from "../base/dom";
import { AnswerError, act, ask } from "../server/answers";

const RANGES = { "1 day": 86_400, "7 days": 7 * 86_400, "30 days": 30 * 86_400 } as const;
const POLL_MS = 1500;

export class Analyse {
  readonly node: HTMLElement;
  private readonly last = el(
    "select",
    { "aria-label": "Drives of the last" },
    ...Object.entries(RANGES).map(([label, seconds]) =>
      el("option", { value: String(seconds) }, `last ${label}`),
    ),
  );
  private readonly button = el("button", { type: "submit", class: "tool" }, "Analyse");
  private robot: string | undefined;
  private run = "";
  private timer: number | undefined;

  /** `say` shows a text; `done` is called with the number of analysed drives. */
  constructor(
    private readonly say: (text: string) => void,
    private readonly done: (drives: number) => void,
  ) {
    this.node = el("form", { class: "range analyse" }, this.last, this.button);
    this.node.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.start();
    });
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
    this.say(error instanceof AnswerError ? error.message : String(error));
  }
}
