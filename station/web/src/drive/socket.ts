// A driver's own connection to the broker: commands to one car, its live messages back, and a lease on them. It is on the
// page's main thread, where the keys are: a page that is frozen must not go on driving.

import type { IClientOptions, MqttClient } from "mqtt";
import {
  CMD,
  LEASE,
  LIVE,
  LIVE_MAX_RATE_HZ,
  SCHEMA_VERSION,
  type SocketAnswer,
  VIEW,
  VIEW_LEASE_MS,
  VIEW_RENEW_S,
} from "../base/contract";
import { newName } from "../base/dom";
import { AnswerError, act, words } from "../server/answers";
import type { Command } from "./command";

declare const mqtt: { connect(url: string, options: IClientOptions): MqttClient };

const RETRY_MS = 1_000;
const CONNECT_MS = 5_000;

export interface Ends {
  readonly message: (topic: string, payload: string) => void;
  /** The connection works if the reason is empty. */
  readonly state: (reason: string) => void;
}

export class DriveSocket {
  private client: MqttClient | undefined;
  private timer: number | undefined;
  private renewing: number | undefined;
  private closed = false;
  private readonly viewer = newName();

  constructor(
    private readonly namespace: string,
    private readonly robot: string,
    private readonly ends: Ends,
  ) {
    void this.open();
  }

  /** Send a command; it is lost if the connection is. */
  send(name: string, command: Command): void {
    if (this.client?.connected)
      this.client.publish(this.topic(CMD, name), JSON.stringify(command), { qos: 0 });
  }

  close(): void {
    this.closed = true;
    window.clearTimeout(this.timer);
    this.lease(0);
    this.client?.end();
    this.drop();
  }

  private topic(lane: string, name: string): string {
    return `${lane}/${this.namespace}/${this.robot}/${name}`;
  }

  private async open(): Promise<void> {
    this.ends.state("Connecting …");
    try {
      await script("mqtt.min.js");
      // An address is for one connection.
      const { url, client_id } = await act<SocketAnswer>("drive", {});
      if (!this.closed) this.connect(url, client_id);
    } catch (error) {
      this.lose(words(error));
    }
  }

  private connect(url: string, clientId: string): void {
    const client = (this.client = mqtt.connect(url, {
      protocolVersion: 5,
      clientId,
      clean: true,
      reconnectPeriod: 0,
      connectTimeout: CONNECT_MS,
      keepalive: 10,
      queueQoSZero: false,
      timerVariant: "native",
    }));
    client.on("connect", () => {
      client.subscribe(this.topic(LIVE, "+"), { qos: 0 }, (error) => {
        if (client !== this.client) return;
        if (error) {
          client.end(true);
          this.lose(`The broker refuses the subscription: ${error.message}`);
          return;
        }
        this.lease(VIEW_LEASE_MS);
        this.renewing = window.setInterval(() => this.lease(VIEW_LEASE_MS), VIEW_RENEW_S * 1000);
        this.ends.state("");
      });
    });
    client.on(
      "message",
      (topic, payload) => client === this.client && this.ends.message(topic, payload.toString()),
    );
    client.on(
      "error",
      (error) => client === this.client && this.lose(`The broker's connection failed: ${error.message}`),
    );
    client.on("close", () => client === this.client && this.lose("The broker's connection ended"));
  }

  /** Have the car send its messages here as often as it may. */
  private lease(lease_ms: number): void {
    if (!this.client?.connected) return;
    const lease = {
      v: SCHEMA_VERSION,
      viewer: this.viewer,
      rate_hz: LIVE_MAX_RATE_HZ,
      lease_ms,
      broker: true,
    };
    this.client.publish(this.topic(VIEW, LEASE), JSON.stringify(lease), { qos: 0 });
  }

  private lose(reason: string): void {
    this.client?.end(true);
    this.drop();
    if (this.closed) return;
    this.ends.state(reason);
    window.clearTimeout(this.timer);
    this.timer = window.setTimeout(() => void this.open(), RETRY_MS);
  }

  private drop(): void {
    this.client = undefined;
    window.clearInterval(this.renewing);
  }
}

/** Load a script of the page, once. */
function script(source: string): Promise<void> {
  const known = document.querySelector<HTMLScriptElement>(`script[src="${source}"]`);
  if (known?.dataset.loaded) return Promise.resolve();
  known?.remove();
  return new Promise((resolve, reject) => {
    const node = document.createElement("script");
    node.addEventListener("load", () => {
      node.dataset.loaded = "true";
      resolve();
    });
    node.addEventListener("error", () => reject(new AnswerError(`${source} could not be loaded`)));
    node.src = source;
    document.head.append(node);
  });
}
