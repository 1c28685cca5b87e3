// A connection of the main thread to the broker, beside the worker's: a driver's, and that of who looks at a picture.
// It opens itself again until it is closed. What is sent without a connection is lost.

import type { IClientOptions, MqttClient } from "mqtt";
import type { SocketAnswer } from "../base/contract";
import { AnswerError, words } from "../server/answers";

declare const mqtt: { connect(url: string, options: IClientOptions): MqttClient };

const RETRY_MS = 1_000;
const CONNECT_MS = 5_000;

export interface Ends {
  /** An address, which is for one connection. */
  readonly address: () => Promise<SocketAnswer>;
  /** What is heard, as topics' filters. */
  readonly topics: () => readonly string[];
  readonly message: (topic: string, payload: Uint8Array) => void;
  /** The connection works if the reason is empty. */
  readonly state: (reason: string) => void;
}

export class Broker {
  private client: MqttClient | undefined;
  private timer: number | undefined;
  private closed = false;
  private works = false;

  constructor(private readonly ends: Ends) {
    void this.open();
  }

  send(topic: string, message: object): void {
    if (this.client?.connected) this.client.publish(topic, JSON.stringify(message), { qos: 0 });
  }

  /** Hear a topic, or not, from now on. */
  hear(topic: string, heard: boolean): void {
    if (!this.client?.connected || !this.works) return;
    if (heard) this.subscribe(this.client, [topic]);
    else this.client.unsubscribe(topic);
  }

  close(): void {
    this.closed = true;
    window.clearTimeout(this.timer);
    this.client?.end();
    this.drop();
  }

  private async open(): Promise<void> {
    this.ends.state("Connecting …");
    try {
      await library();
      const { url, client_id } = await this.ends.address();
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
    client.on("connect", () =>
      this.subscribe(client, this.ends.topics(), () => {
        this.works = true;
        this.ends.state("");
      }),
    );
    client.on(
      "message",
      (topic, payload) => client === this.client && this.ends.message(topic, new Uint8Array(payload)),
    );
    client.on(
      "error",
      (error) => client === this.client && this.lose(`The broker's connection failed: ${error.message}`),
    );
    client.on("close", () => client === this.client && this.lose("The broker's connection ended"));
  }

  private subscribe(client: MqttClient, topics: readonly string[], done?: () => void): void {
    client.subscribe([...topics], { qos: 0 }, (error) => {
      if (client !== this.client) return;
      if (!error) return done?.();
      client.end(true);
      this.lose(`The broker refuses the subscription: ${error.message}`);
    });
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
    [this.client, this.works] = [undefined, false];
  }
}

let loading: Promise<void> | undefined;

/** The library, which only a page that needs it loads. */
function library(): Promise<void> {
  loading ??= new Promise((resolve, reject) => {
    const node = document.createElement("script");
    node.addEventListener("load", () => resolve());
    node.addEventListener("error", () => {
      loading = undefined;
      node.remove();
      reject(new AnswerError("mqtt.min.js could not be loaded"));
    });
    node.src = "mqtt.min.js";
    document.head.append(node);
  });
  return loading;
}
