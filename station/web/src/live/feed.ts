// Starts the page's worker, and hands its messages to the fleet.

import { now } from "../base/clock";
import type { Config, FieldTable } from "../base/contract";
import { newName } from "../base/dom";
import { keep, kept } from "../base/kept";
import type { FromWorker, Lease, LinkState, ToWorker } from "../link/worker_messages";
import type { Fleet } from "./fleet";

export class Feed {
  state: LinkState = { kind: "connecting" };
  private readonly worker = new Worker("worker.js");

  constructor(config: Config, table: FieldTable, fleet: Fleet, onState: (state: LinkState) => void) {
    this.worker.addEventListener("message", ({ data }: MessageEvent<FromWorker>) => {
      if (data.kind === "arrivals") {
        fleet.take(data.arrivals, data.refused);
        this.tell({ kind: "taken" });
      } else {
        this.state = data.state;
        onState(data.state);
      }
    });
    this.worker.addEventListener("error", (event) => {
      this.state = {
        kind: "lost",
        since: now(),
        retryAt: now(),
        reason: `the page's worker failed: ${event.message}`,
      };
      onState(this.state);
    });
    const { namespace, live, identity, subscribe_key, origin, tls, token } = config;
    const { version } = table;
    this.tell({
      kind: "start",
      listening: { namespace, live, identity, version, subscribe_key, origin, tls, token, user: userId() },
    });
    document.addEventListener("visibilitychange", () =>
      this.tell({ kind: "visible", visible: !document.hidden }),
    );
  }

  /** Ask cars for their live messages over the page's own connection. */
  lease(lease: Lease): void {
    this.tell({ kind: "lease", lease });
  }

  private tell(message: ToWorker): void {
    this.worker.postMessage(message);
  }
}

/** An id for this browser: PubNub bills by users, and a reload must not be a new user. */
function userId(): string {
  const fresh = `page-${newName()}`;
  const known = kept("user");
  if (known && /^page-[0-9a-f]{16}$/.test(known)) return known;
  // Without storage, every visit is a new user.
  keep("user", fresh);
  return fresh;
}
