// The page's worker: it subscribes to live messages, and decodes and checks every message, so that the drawing thread
// does not have to.

import { now } from "./base/clock";
import { IotLink } from "./link/iot_link";
import { PubNubLink } from "./link/pubnub_link";
import { parseLive, parseUpdate, type Update } from "./link/update";
import type { Arrival, FromWorker, LinkState, Listening, ToWorker } from "./link/worker_messages";

// Messages of this time are handed over together, because each handover wakes the page.
const TOGETHER_MS = 25;
// The most messages that wait for a busy page; beyond that the oldest is dropped.
const MOST_WAITING = 2_000;

let link: IotLink | PubNubLink | undefined;
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

function take(update: Update | string, pubnub_us?: number): void {
  if (typeof update === "string") {
    refused += 1;
    lastRefusal = update;
  } else {
    arrivals.push({ update, at: now(), wall_us: Date.now() * 1000, pubnub_us });
  }
  if (arrivals.length > MOST_WAITING) {
    arrivals.shift();
    refused += 1;
    lastRefusal = "more than this device can show";
  }
  handing ??= self.setTimeout(hand, TOGETHER_MS);
}

function start(listening: Listening): void {
  const { namespace, version } = listening;
  const onState = (state: LinkState): void => tell({ kind: "state", state });
  link =
    listening.live === "iot"
      ? new IotLink(listening, now, (topic, payload) => take(parseLive(namespace, version, topic, payload)), onState)
      : // A timetoken counts 100 ns.
        new PubNubLink(listening, now, (channel, message, timetoken) => take(parseUpdate(namespace, version, channel, message), Number(timetoken) / 10), onState);
  link.connect();
}

self.addEventListener("message", (event: MessageEvent<ToWorker>) => {
  const { data } = event;
  if (data.kind === "start") start(data.listening);
  else if (data.kind === "visible") link?.seen(data.visible);
  else if (data.kind === "lease") {
    if (link instanceof IotLink) link.lease(data.lease);
  }
  else {
    taking = false;
    if (arrivals.length > 0 || refused > 0) handing ??= self.setTimeout(hand, TOGETHER_MS);
  }
});
