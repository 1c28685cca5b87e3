// The connection to PubNub. The SDK gives up after a few failures, and after a reconnect it delivers old
// messages. A live page must neither give up nor fall behind, so this starts a new subscription each time.

import type PubNubSdk from "pubnub";
import type { LinkState, Listening } from "./worker_messages";

// The SDK's licence allows unmodified copies, so the SDK is not bundled: it is a file of its own.
declare function importScripts(...urls: string[]): void;
declare const PubNub: typeof PubNubSdk;

const FIRST_RETRY_S = 0.5;
const LAST_RETRY_S = 5;
const REFUSED_RETRY_S = 30;
// After this time without a message, a time request tells a quiet fleet from a dead connection.
const PROBE_S = 8;
const ANSWER_S = 5;
// PubNub bills every message to every page, so a hidden page stops listening after this time.
const HIDDEN_S = 60;

const REASONS: Readonly<Record<string, string>> = {
  PNAccessDeniedCategory: "PubNub refuses the access",
  PNBadRequestCategory: "PubNub refuses the request: is the subscribe key right?",
  PNNetworkIssuesCategory: "PubNub cannot be reached",
  PNTimeoutCategory: "PubNub does not answer",
  PNMalformedResponseCategory: "an answer that is not PubNub's",
};

export class PubNubLink {
  state: LinkState = { kind: "connecting" };
  private readonly pubnub: PubNubSdk;
  private readonly channel: string;
  private attempt = 0;
  private retry: number | undefined;
  private pause: number | undefined;
  private heardAt = 0;
  private probing = false;
  private visible = true;
  /** Late statuses of an ended subscription are ignored. */
  private subscribed = false;

  constructor(
    listening: Listening,
    private readonly now: () => number,
    onMessage: (channel: string, message: unknown, timetoken: string) => void,
    private readonly onState: (state: LinkState) => void,
  ) {
    importScripts("pubnub.min.js");
    this.channel = `${listening.namespace}.*`;
    this.pubnub = new PubNub({
      subscribeKey: listening.subscribe_key,
      userId: listening.user,
      origin: listening.origin,
      ssl: listening.tls,
      restore: false,
      suppressLeaveEvents: true,
      listenToBrowserNetworkEvents: false,
      transactionalRequestTimeout: ANSWER_S,
      subscribeRequestTimeout: 310,
      retryConfiguration: PubNub.NoneRetryPolicy(),
    });
    if (listening.token) this.pubnub.setToken(listening.token);
    this.pubnub.addListener({
      message: (event) => {
        this.heardAt = this.now();
        onMessage(event.channel, event.message, String(event.timetoken));
      },
      status: (event) => this.take(event.category, "error" in event ? event.error : undefined),
    });
    self.addEventListener("online", () => this.state.kind === "lost" && this.connect());
    self.addEventListener("offline", () => this.lose("this device is offline", LAST_RETRY_S));
    self.setInterval(() => this.probe(), 1000);
  }

  connect(): void {
    self.clearTimeout(this.retry);
    this.subscribed = false;
    this.pubnub.unsubscribeAll();
    this.subscribed = true;
    this.heardAt = this.now();
    this.pubnub.subscribe({ channels: [this.channel] });
    this.retry = self.setTimeout(() => this.lose("PubNub does not answer", FIRST_RETRY_S), ANSWER_S * 1000);
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

  private stop(): void {
    self.clearTimeout(this.retry);
    this.subscribed = false;
    this.pubnub.unsubscribeAll();
    this.change({ kind: "paused" });
  }

  private take(category: string | undefined, error: unknown): void {
    if (!this.subscribed) return;
    switch (category) {
      case PubNub.CATEGORIES.PNConnectedCategory:
        self.clearTimeout(this.retry);
        this.attempt = 0;
        this.heardAt = this.now();
        this.change({ kind: "live", downFor: this.state.kind === "lost" ? this.now() - this.state.since : undefined });
        break;
      case PubNub.CATEGORIES.PNConnectionErrorCategory:
      case PubNub.CATEGORIES.PNDisconnectedUnexpectedlyCategory:
      case PubNub.CATEGORIES.PNNetworkIssuesCategory:
      case PubNub.CATEGORIES.PNTimeoutCategory:
      case PubNub.CATEGORIES.PNAccessDeniedCategory:
      case PubNub.CATEGORIES.PNBadRequestCategory:
      case PubNub.CATEGORIES.PNMalformedResponseCategory: {
        const cause = typeof error === "string" ? error : category;
        const refused = cause === "PNAccessDeniedCategory" || cause === "PNBadRequestCategory";
        const backoff = Math.min(LAST_RETRY_S, FIRST_RETRY_S * 2 ** this.attempt) * (0.75 + Math.random() / 2);
        this.lose(REASONS[cause] ?? "the connection ended", refused ? REFUSED_RETRY_S : backoff);
        break;
      }
    }
  }

  private lose(reason: string, wait: number): void {
    if (this.state.kind === "paused") return;
    this.subscribed = false;
    this.attempt += 1;
    self.clearTimeout(this.retry);
    this.retry = self.setTimeout(() => this.connect(), wait * 1000);
    const since = this.state.kind === "lost" ? this.state.since : this.now();
    this.change({ kind: "lost", since, retryAt: this.now() + wait, reason });
  }

  private async probe(): Promise<void> {
    if (this.state.kind !== "live" || this.probing || !this.visible || this.now() - this.heardAt < PROBE_S) return;
    this.probing = true;
    const asked = this.now();
    try {
      await this.pubnub.time();
      this.heardAt = this.now();
    } catch {
      if (this.heardAt < asked) this.lose("PubNub does not answer", FIRST_RETRY_S);
    } finally {
      this.probing = false;
    }
  }

  private change(state: LinkState): void {
    this.state = state;
    this.onState(state);
  }
}
