// The page's worker: it subscribes to PubNub, and decodes and checks every message, so that the drawing thread
// does not have to.

import { now } from "./base/clock";
import { PubNubLink } from "./link/pubnub_link";
import { parseUpdate } from "./link/update";
import type { Arrival, FromWorker, Listening, ToWorker } from "./link/worker_messages";

// Messages of this time are handed over together, because each handover wakes the page.
const TOGETHER_MS = 25;
// The most messages that wait for a busy page; beyond that the oldest is dropped.
const MOST_WAITING = 2_000;

let link: PubNubLink | undefined;
let arrivals: Arrival[] = [];
let refused = 0;
let lastRefusal = "";
let handing: number | undefined;
let taking = false;

const tell = (message: FromWorker): void => self.postMessage(message);

function hand(): void {
  handing = undefined;
  if (taking) return;
  taking = true;
  tell({ kind: "arrivals", arrivals, refused, lastRefusal });
  arrivals = [];
  refused = 0;
}

function start(listening: Listening): void {
  link = new PubNubLink(
    listening,
    now,
    (channel, message, timetoken) => {
      const [at, wall_us] = [now(), Date.now() * 1000];
      const update = parseUpdate(listening.namespace, listening.version, channel, message);
      if (typeof update === "string") {
        refused += 1;
        lastRefusal = update;
      } else {
        // A timetoken counts 100 ns.
        arrivals.push({ update, at, wall_us, pubnub_us: Number(timetoken) / 10 });
      }
      if (arrivals.length > MOST_WAITING) {
        arrivals.shift();
        refused += 1;
        lastRefusal = "more than this device can show";
      }
      handing ??= self.setTimeout(hand, TOGETHER_MS);
    },
    (state) => tell({ kind: "state", state }),
  );
  link.connect();
}

self.addEventListener("message", (event: MessageEvent<ToWorker>) => {
  const { data } = event;
  if (data.kind === "start") start(data.listening);
  else if (data.kind === "visible") link?.seen(data.visible);
  else {
    taking = false;
    if (arrivals.length > 0 || refused > 0) handing ??= self.setTimeout(hand, TOGETHER_MS);
  }
});
