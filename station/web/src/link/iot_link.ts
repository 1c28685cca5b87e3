// The connection to AWS IoT's WebSocket, by MQTT 5. Each attempt has a new address, because a signature lasts minutes.

import type { MqttClient } from "mqtt";
import { LEASE, LIVE, SCHEMA_VERSION, VIEW } from "../base/contract";
import { AnswerError } from "../server/answers";
import { ANSWER_S, Link, REFUSED_RETRY_S } from "./link";
import { socketAddress } from "./socket_address";
import type { Lease, LinkState, Listening } from "./worker_messages";

// A file of its own, which only a page that needs it loads.
declare function importScripts(...urls: string[]): void;
declare const mqtt: { readonly connect: typeof import("mqtt").connect };

// An address takes several requests to AWS, and the connection several round trips.
const OPEN_S = 15;
const CONNECT_S = 10;
// The least that AWS IoT allows; the probe finds a dead connection sooner.
const KEEPALIVE_S = 30;
// The most that AWS IoT takes in one request to subscribe.
const MOST_FILTERS = 8;
// A reason code of MQTT 5 from this on is a failure.
const FAILED = 0x80;

export class IotLink extends Link {
  private client: MqttClient | undefined;
  /** Changes with each attempt, so that what comes of an older one is ignored. */
  private opened = 0;

  constructor(
    private readonly listening: Listening,
    now: () => number,
    private readonly onMessage: (topic: string, payload: Uint8Array) => void,
    onState: (state: LinkState) => void,
  ) {
    super("AWS IoT", now, onState, OPEN_S);
    importScripts("mqtt.min.js");
  }

  /** Ask cars for their live messages; lost without a connection, since the next renewal comes soon. */
  lease({ robots, ...lease }: Lease): void {
    if (this.state.kind !== "live") return;
    const payload = JSON.stringify({ v: SCHEMA_VERSION, ...lease, broker: true });
    for (const robot of robots)
      this.client?.publish([VIEW, this.listening.namespace, robot, LEASE].join("/"), payload);
  }

  protected open(): void {
    void this.dial((this.opened += 1));
  }

  protected close(): void {
    this.opened += 1;
    const { client } = this;
    this.client = undefined;
    client?.end(true);
  }

  protected probe(): Promise<void> {
    const { client } = this;
    return new Promise((answered, failed) => {
      const late = self.setTimeout(failed, ANSWER_S * 1000);
      client?.on("packetreceive", function pong({ cmd }) {
        if (cmd !== "pingresp") return;
        client.off("packetreceive", pong);
        self.clearTimeout(late);
        answered();
      });
      client?.sendPing();
    });
  }

  private async dial(opened: number): Promise<void> {
    const { namespace, identity } = this.listening;
    let client: MqttClient;
    try {
      const { url, client_id } = await socketAddress(identity);
      if (opened !== this.opened) return;
      client = mqtt.connect(url, {
        protocolVersion: 5,
        clientId: client_id,
        clean: true,
        reconnectPeriod: 0,
        resubscribe: false,
        subscribeBatchSize: MOST_FILTERS,
        keepalive: KEEPALIVE_S,
        connectTimeout: CONNECT_S * 1000,
        timerVariant: "native",
      });
    } catch (error) {
      if (opened !== this.opened) return;
      if (error instanceof AnswerError) this.lose(error.message);
      else this.lose(`AWS IoT's address could not be had: ${String(error)}`);
      return;
    }
    this.client = client;
    const robots = identity && identity.robots.length > 0 ? identity.robots : ["+"];
    client.on("connect", () =>
      client.subscribe(
        robots.map((robot) => [LIVE, namespace, robot, "+"].join("/")),
        { qos: 0 },
        (error, granted) => {
          if (opened !== this.opened) return;
          if (error || granted?.some(({ qos }) => qos >= FAILED))
            this.lose("AWS IoT refuses the subscription", REFUSED_RETRY_S);
          else this.connected();
        },
      ),
    );
    client.on("message", (topic, payload) => {
      if (opened !== this.opened) return;
      this.heard();
      this.onMessage(topic, payload);
    });
    client.on(
      "error",
      (error) =>
        opened === this.opened &&
        this.lose(
          "code" in error && error.code
            ? `AWS IoT refuses the connection: ${error.message}`
            : "AWS IoT cannot be reached",
        ),
    );
    client.on("close", () => opened === this.opened && this.lose("the connection ended"));
  }
}
