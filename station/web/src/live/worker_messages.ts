// What the page and its worker say to each other.

import type { Update } from "./update";

export type LinkState =
  | { readonly kind: "connecting" }
  | { readonly kind: "paused" }
  | { readonly kind: "live"; readonly downFor: number | undefined }
  | { readonly kind: "lost"; readonly since: number; readonly retryAt: number; readonly reason: string };

/** Where to listen, and as whom. */
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
  /** The page has taken what was handed over, and is ready for more. */
  | { readonly kind: "taken" };

/** An update, and when it came: on the page's clock in seconds, and by the time of day in microseconds. */
export interface Arrival {
  readonly update: Update;
  readonly at: number;
  readonly wall_us: number;
  /** When PubNub took it, in microseconds since the epoch, by PubNub's clock. */
  readonly pubnub_us: number;
}

export type FromWorker =
  | { readonly kind: "state"; readonly state: LinkState }
  | { readonly kind: "arrivals"; readonly arrivals: readonly Arrival[]; readonly refused: number; readonly lastRefusal: string };
