// The live update as Lambda 1 sends it (iort_contract.live_update), checked field by field. Any other
// message on the channel is rejected with a reason.

import { BOOT, FIELD_NAME, MAX_FIELDS, MAX_NEXT_MS, NAME, type Value } from "../base/contract";

export interface Hops {
  readonly sent_us: number;
  readonly received_ms: number;
  readonly lambda_us: number;
  /** Added to the car's times, it gives the cloud's; 0 if the car has not measured it. */
  readonly offset_us: number;
  readonly offset_known: boolean;
}

export interface Update {
  readonly robot: string;
  readonly stream: string;
  readonly boot: string;
  readonly seq: number;
  readonly t_us: number;
  /** The stream's next message leaves the car within this time, if there are samples; 0 if the car does not say. */
  readonly next_ms: number;
  readonly hops: Hops;
  readonly sample: ReadonlyMap<string, Value>;
}

/** The update, or the reason of its rejection. The channel names the robot, never the body. */
export function parseUpdate(namespace: string, version: number, channel: string, message: unknown): Update | string {
  const robot = channel.startsWith(`${namespace}.`) ? channel.slice(namespace.length + 1) : "";
  if (!NAME.test(robot)) return "a channel that names no robot";
  if (!isObject(message)) return "not an object";
  const { v, stream, boot, seq, t, next_ms = 0, hops, sample } = message;
  if (v !== version) return "another schema version";
  if (message["robot"] !== robot) return "another robot's name";
  if (typeof stream !== "string" || !NAME.test(stream)) return "no stream name";
  if (typeof boot !== "string" || !BOOT.test(boot)) return "no boot id";
  if (!isInteger(seq) || seq < 0) return "no sequence number";
  if (!isInteger(t)) return "no sample time";
  if (!isInteger(next_ms) || next_ms < 0 || next_ms > MAX_NEXT_MS) return "no time of the next message";
  if (!isObject(hops)) return "no hop times";
  const { sent_us, received_ms, lambda_us, offset_us = 0 } = hops;
  if (!isInteger(sent_us) || !isInteger(received_ms) || !isInteger(lambda_us) || !isInteger(offset_us)) return "a hop without its time";
  if (!isObject(sample)) return "no sample";
  const entries = Object.entries(sample);
  if (entries.length > MAX_FIELDS) return "too many fields";
  const values = new Map<string, Value>();
  for (const [name, value] of entries) {
    if (!FIELD_NAME.test(name)) return "a field name that is not allowed";
    if (!isValue(value)) return "a value that is neither number, text, true, false nor null";
    values.set(name, value);
  }
  return { robot, stream, boot, seq, t_us: t, next_ms, hops: { sent_us, received_ms, lambda_us, offset_us, offset_known: Object.hasOwn(hops, "offset_us") }, sample: values };
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isInteger(value: unknown): value is number {
  return Number.isSafeInteger(value);
}

function isValue(value: unknown): value is Value {
  return value === null || typeof value === "boolean" || typeof value === "number" || typeof value === "string";
}
