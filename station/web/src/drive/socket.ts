// A driver's own connection to the broker: commands to one car, its live messages back, and a lease on them. It is on the
// page's main thread, where the keys are: a page that is frozen must not go on driving.

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
import { Broker, type Ends } from "../link/broker";
import { act } from "../server/answers";
import type { Command } from "./command";

const TEXT = new TextDecoder();

export class DriveSocket {
  private readonly broker: Broker;
  private readonly renewing: number;
  private readonly viewer = newName();

  constructor(
    private readonly namespace: string,
    private readonly robot: string,
    message: (topic: string, payload: string) => void,
    state: Ends["state"],
  ) {
    this.broker = new Broker({
      address: () => act<SocketAnswer>("drive", {}),
      topics: () => [this.topic(LIVE, "+")],
      message: (topic, payload) => message(topic, TEXT.decode(payload)),
      state: (reason) => {
        if (reason === "") this.lease(VIEW_LEASE_MS);
        state(reason);
      },
    });
    this.renewing = window.setInterval(() => this.lease(VIEW_LEASE_MS), VIEW_RENEW_S * 1000);
  }

  /** Send a command; it is lost if the connection is. */
  send(name: string, command: Command): void {
    this.broker.send(this.topic(CMD, name), command);
  }

  close(): void {
    window.clearInterval(this.renewing);
    this.lease(0);
    this.broker.close();
  }

  private topic(lane: string, name: string): string {
    return `${lane}/${this.namespace}/${this.robot}/${name}`;
  }

  /** Have the car send its messages here as often as it may. */
  private lease(lease_ms: number): void {
    this.broker.send(this.topic(VIEW, LEASE), {
      v: SCHEMA_VERSION,
      viewer: this.viewer,
      rate_hz: LIVE_MAX_RATE_HZ,
      lease_ms,
      broker: true,
    });
  }
}
