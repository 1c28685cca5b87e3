// The messages between the page and its worker.

import type { Update } from "./update";

export type LinkState =
  | { readonly kind: "connecting" }
  | { readonly kind: "paused" }
  | { readonly kind: "live"; readonly downFor: number | undefined }
  | { readonly kind: "lost"; readonly since: number; readonly retryAt: number; readonly reason: string };

/** The settings of the subscription. */
export interface Listening {
  readonly namespace: string;
  readonly version: number;
  readonly subscribe_key: string;
  readonly origin: string;
  readonly tls: boolean;
  readonly token: string;
  readonly user: string;
}

export type ToWorker =
  | { readonly kind: "start"; readonly listening: Listening }
  | { readonly kind: "visible"; readonly visible: boolean }
  /** The page has processed the last handover, and is ready for the next. */
  | { readonly kind: "taken" };

/** An update and its arrival: on the page's clock in seconds, and as wall time in microseconds. */
export interface Arrival {
  readonly update: Update;
  readonly at: number;
  readonly wall_us: number;
  /** The time at which PubNub took it, in microseconds since the epoch, by PubNub's clock. */
  readonly pubnub_us: number;
}

export type FromWorker =
  | { readonly kind: "state"; readonly state: LinkState }
  | { readonly kind: "arrivals"; readonly arrivals: readonly Arrival[]; readonly refused: number; readonly lastRefusal: string };
