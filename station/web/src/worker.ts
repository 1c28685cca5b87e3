// The page's worker: it subscribes to live messages, and decodes and checks every message, so that the drawing thread
// does not have to.

import { now } from "./base/clock";
import { NAME } from "./base/contract";
import { IotLink } from "./link/iot_link";
import { PubNubLink } from "./link/pubnub_link";
import { parseLive, parseUpdate, type Update } from "./link/update";
import type { Arrival, FromWorker, LinkState, Listening, Refused, ToWorker } from "./link/worker_messages";

// Each handover wakes the page, so there is this time between two. A message after a pause is handed over at once,
// together with those that came with it.
const TOGETHER_MS = 25;
// The most messages that wait for a busy page; beyond that the oldest is dropped.
const MOST_WAITING = 2_000;
// Names come from the network; beyond this many, rejected messages are counted together.
const MOST_NAMED = 200;

let link: IotLink | PubNubLink | undefined;
let arrivals: Arrival[] = [];
const refused = new Map<string, Refused>();
let timer: number | undefined;
let taking = false;
let handedAt = -Infinity;

const tell = (message: FromWorker): void => self.postMessage(message);

function hand(): void {
  timer = undefined;
  if (taking) return;
  taking = true;
  handedAt = now();
  tell({ kind: "arrivals", arrivals, refused: [...refused.values()] });
  arrivals = [];
  refused.clear();
}

function handSoon(): void {
  if (timer !== undefined) return;
  timer = self.setTimeout(hand, Math.max(0, TOGETHER_MS - 1000 * (now() - handedAt)));
}

function refuse(robot: string, reason: string): void {
  refused.set(robot, { robot, messages: (refused.get(robot)?.messages ?? 0) + 1, reason });
}

/** `from` is the robot that the message's channel or topic names. */
function take(update: Update | string, from: string, pubnub_us?: number): void {
  if (typeof update === "string") {
    refuse(NAME.test(from) && (refused.has(from) || refused.size < MOST_NAMED) ? from : "", update);
  } else {
    arrivals.push({ update, at: now(), wall_us: Date.now() * 1000, pubnub_us });
  }
  if (arrivals.length > MOST_WAITING) {
    const dropped = arrivals.shift();
    refuse(dropped?.update.robot ?? "", "more than this device can show");
  }
  handSoon();
}

function start(listening: Listening): void {
  const { namespace, version } = listening;
  const onState = (state: LinkState): void => tell({ kind: "state", state });
  link =
    listening.live === "iot"
      ? new IotLink(
          listening,
          now,
          (topic, payload) => take(parseLive(namespace, version, topic, payload), topic.split("/")[2] ?? ""),
          onState,
        )
      : // A timetoken counts 100 ns.
        new PubNubLink(
          listening,
          now,
          (channel, message, timetoken) =>
            take(
              parseUpdate(namespace, version, channel, message),
              channel.slice(namespace.length + 1),
              Number(timetoken) / 10,
            ),
          onState,
        );
  link.connect();
}

self.addEventListener("message", (event: MessageEvent<ToWorker>) => {
  const { data } = event;
  if (data.kind === "start") start(data.listening);
  else if (data.kind === "visible") link?.seen(data.visible);
  else if (data.kind === "lease") {
    if (link instanceof IotLink) link.lease(data.lease);
  } else {
    taking = false;
    if (arrivals.length > 0 || refused.size > 0) handSoon();
  }
});
