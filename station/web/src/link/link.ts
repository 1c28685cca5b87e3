// A connection for live messages. A live page must neither give up nor fall behind, so each attempt begins anew, and
// nothing of the time between is delivered.

import type { LinkState } from "./worker_messages";

export const FIRST_RETRY_S = 0.5;
const LAST_RETRY_S = 5;
/** Asking again sooner does not change a refusal. */
export const REFUSED_RETRY_S = 30;
export const ANSWER_S = 5;
// After this time without a message, a question tells a quiet fleet from a dead connection.
const PROBE_S = 8;
// Every message to every page is billed, so a hidden page stops listening after this time.
const HIDDEN_S = 60;

export abstract class Link {
  state: LinkState = { kind: "connecting" };
  private attempt = 0;
  private retry: number | undefined;
  private pause: number | undefined;
  private heardAt = 0;
  private probing = false;
  private visible = true;

  constructor(
    private readonly other: string,
    private readonly now: () => number,
    private readonly onState: (state: LinkState) => void,
    private readonly answer_s = ANSWER_S,
  ) {
    self.addEventListener("online", () => this.state.kind === "lost" && this.connect());
    self.addEventListener("offline", () => this.lose("this device is offline", LAST_RETRY_S));
    self.setInterval(() => void this.look(), 1000);
  }

  connect(): void {
    self.clearTimeout(this.retry);
    this.close();
    this.heardAt = this.now();
    this.retry = self.setTimeout(
      () => this.lose(`${this.other} does not answer`, FIRST_RETRY_S),
      this.answer_s * 1000,
    );
    this.open();
  }

  /** Take whether the page is visible. */
  seen(visible: boolean): void {
    this.visible = visible;
    self.clearTimeout(this.pause);
    if (!visible) this.pause = self.setTimeout(() => this.stop(), HIDDEN_S * 1000);
    else if (this.state.kind === "paused") {
      this.change({ kind: "connecting" });
      this.connect();
    }
  }

  /** Begin to subscribe, and call `connected` or `lose`. */
  protected abstract open(): void;

  /** End the subscription; nothing of it is heard any more. */
  protected abstract close(): void;

  /** Ask the other side for an answer; resolves when it comes. */
  protected abstract probe(): Promise<void>;

  protected heard(): void {
    this.heardAt = this.now();
  }

  protected connected(): void {
    self.clearTimeout(this.retry);
    this.attempt = 0;
    this.heard();
    this.change({
      kind: "live",
      downFor: this.state.kind === "lost" ? this.now() - this.state.since : undefined,
    });
  }

  /** The connection is lost, and the next attempt is in `wait` seconds. */
  protected lose(
    reason: string,
    wait = Math.min(LAST_RETRY_S, FIRST_RETRY_S * 2 ** this.attempt) * (0.75 + Math.random() / 2),
  ): void {
    if (this.state.kind === "paused") return;
    this.close();
    this.attempt += 1;
    self.clearTimeout(this.retry);
    this.retry = self.setTimeout(() => this.connect(), wait * 1000);
    const since = this.state.kind === "lost" ? this.state.since : this.now();
    this.change({ kind: "lost", since, retryAt: this.now() + wait, reason });
  }

  private stop(): void {
    self.clearTimeout(this.retry);
    this.close();
    this.change({ kind: "paused" });
  }

  private async look(): Promise<void> {
    if (this.state.kind !== "live" || this.probing || !this.visible || this.now() - this.heardAt < PROBE_S)
      return;
    this.probing = true;
    const asked = this.now();
    try {
      await this.probe();
      this.heard();
    } catch {
      if (this.heardAt < asked) this.lose(`${this.other} does not answer`, FIRST_RETRY_S);
    } finally {
      this.probing = false;
    }
  }

  private change(state: LinkState): void {
    this.state = state;
    this.onState(state);
  }
}
