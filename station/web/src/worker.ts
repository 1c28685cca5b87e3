// Everything between the network and the page's picture of the fleet: PubNub's subscription, the decoding
// and the checking of every message, away from the thread that draws.

import { now } from "./clock";
import { Link } from "./link";
import { parseUpdate } from "./message";
import type { Arrival, FromWorker, Listening, ToWorker } from "./wire";

// What comes within this long is handed over together: each handing over wakes the page.
const TOGETHER_MS = 25;

let link: Link | undefined;
let arrivals: Arrival[] = [];
let refused = 0;
let lastRefusal = "";
let handing: number | undefined;

const tell = (message: FromWorker): void => self.postMessage(message);

function hand(): void {
  handing = undefined;
  tell({ kind: "arrivals", arrivals, refused, lastRefusal });
  arrivals = [];
  refused = 0;
}

function start(listening: Listening): void {
  link = new Link(
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
      handing ??= self.setTimeout(hand, TOGETHER_MS);
    },
    (state) => tell({ kind: "state", state }),
  );
  link.connect();
}

self.addEventListener("message", (event: MessageEvent<ToWorker>) => {
  if (event.data.kind === "start") start(event.data.listening);
  else link?.seen(event.data.visible);
});
