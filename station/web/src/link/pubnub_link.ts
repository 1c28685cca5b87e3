// The connection to PubNub. The SDK gives up after a few failures, and after a reconnect it delivers old messages, so
// each attempt is a new subscription.

import type PubNubSdk from "pubnub";
import { ANSWER_S, Link, REFUSED_RETRY_S } from "./link";
import type { LinkState, Listening } from "./worker_messages";

// The SDK's licence allows unmodified copies, so the SDK is not bundled: it is a file of its own.
declare function importScripts(...urls: string[]): void;
declare const PubNub: typeof PubNubSdk;

const REASONS: Readonly<Record<string, string>> = {
  PNAccessDeniedCategory: "PubNub refuses the access",
  PNBadRequestCategory: "PubNub refuses the request: is the subscribe key right?",
  PNNetworkIssuesCategory: "PubNub cannot be reached",
  PNTimeoutCategory: "PubNub does not answer",
  PNMalformedResponseCategory: "an answer that is not PubNub's",
};

export class PubNubLink extends Link {
  private readonly pubnub: PubNubSdk;
  private readonly channel: string;
  /** Late statuses of an ended subscription are ignored. */
  private subscribed = false;

  constructor(
    listening: Listening,
    now: () => number,
    onMessage: (channel: string, message: unknown, timetoken: string) => void,
    onState: (state: LinkState) => void,
  ) {
    super("PubNub", now, onState);
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
        this.heard();
        onMessage(event.channel, event.message, String(event.timetoken));
      },
      status: (event) => this.take(event.category, "error" in event ? event.error : undefined),
    });
  }

  protected open(): void {
    this.subscribed = true;
    this.pubnub.subscribe({ channels: [this.channel] });
  }

  protected close(): void {
    this.subscribed = false;
    this.pubnub.unsubscribeAll();
  }

  protected async probe(): Promise<void> {
    await this.pubnub.time();
  }

  private take(category: string | undefined, error: unknown): void {
    if (!this.subscribed) return;
    switch (category) {
      case PubNub.CATEGORIES.PNConnectedCategory:
        this.connected();
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
        this.lose(REASONS[cause] ?? "the connection ended", refused ? REFUSED_RETRY_S : undefined);
        break;
      }
    }
  }
}
