// The messages between the page and its worker.

import type { Config } from "../base/contract";
import type { Update } from "./update";

export type LinkState =
  | { readonly kind: "connecting" }
  | { readonly kind: "paused" }
  | { readonly kind: "live"; readonly downFor: number | undefined }
  | { readonly kind: "lost"; readonly since: number; readonly retryAt: number; readonly reason: string };

/** The settings of the subscription. */
export interface Listening
  extends Pick<Config, "namespace" | "live" | "identity" | "subscribe_key" | "origin" | "tls" | "token"> {
  readonly version: number;
  readonly user: string;
}

/** A viewer's lease on the live lanes of robots; 0 ms ends it. */
export interface Lease {
  readonly robots: readonly string[];
  readonly viewer: string;
  readonly rate_hz: number;
  readonly lease_ms: number;
}

export type ToWorker =
  | { readonly kind: "start"; readonly listening: Listening }
  | { readonly kind: "visible"; readonly visible: boolean }
  | { readonly kind: "lease"; readonly lease: Lease }
  /** The page has processed the last handover, and is ready for the next. */
  | { readonly kind: "taken" };

/** An update and its arrival: on the page's clock in seconds, and as wall time in microseconds. */
export interface Arrival {
  readonly update: Update;
  readonly at: number;
  readonly wall_us: number;
  /** When PubNub took it, in microseconds since the epoch, by PubNub's clock; undefined if it came otherwise. */
  readonly pubnub_us: number | undefined;
}

/** Messages that were rejected, and why the last one was; of no robot if its name cannot be told. */
export interface Refused {
  readonly robot: string;
  readonly messages: number;
  readonly reason: string;
}

export type FromWorker =
  | { readonly kind: "state"; readonly state: LinkState }
  | {
      readonly kind: "arrivals";
      readonly arrivals: readonly Arrival[];
      readonly refused: readonly Refused[];
    };
