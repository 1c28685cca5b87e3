// A live message as Lambda 1 sends it to PubNub (iort_contract.live_update), or as the car sends it to the broker
// (iort_contract.encode_live), checked field by field. Any other message is rejected with a reason.

import {
  ABSENT_FROM,
  BOOT,
  FIELD_NAME,
  LIVE,
  MAX_FIELDS,
  MAX_NEXT_MS,
  NAME,
  type Value,
} from "../base/contract";

export interface Hops {
  readonly sent_us: number;
  /** When the rule and the function had it; undefined for a message that came straight from the broker. */
  readonly received_ms: number | undefined;
  readonly lambda_us: number | undefined;
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

/** PubNub's message as an update, or the reason of its rejection. The channel names the robot, never the body. */
export function parseUpdate(
  namespace: string,
  version: number,
  channel: string,
  message: unknown,
): Update | string {
  const robot = channel.startsWith(`${namespace}.`) ? channel.slice(namespace.length + 1) : "";
  if (!NAME.test(robot)) return "a channel that names no robot";
  if (!isObject(message)) return "not an object";
  const { stream, hops } = message;
  if (message.robot !== robot) return "another robot's name";
  if (typeof stream !== "string" || !NAME.test(stream)) return "no stream name";
  if (!isObject(hops)) return "no hop times";
  const { received_ms, lambda_us } = hops;
  if (!isInteger(received_ms) || !isInteger(lambda_us)) return "a hop without its time";
  return parse(version, message, hops, { robot, stream, received_ms, lambda_us });
}

/** A car's own message as an update, or the reason of its rejection. The topic names robot and stream. */
export function parseLive(
  namespace: string,
  version: number,
  topic: string,
  payload: Uint8Array,
): Update | string {
  const [lane, space, robot = "", stream = "", ...more] = topic.split("/");
  if (lane !== LIVE || space !== namespace || more.length > 0 || !NAME.test(robot) || !NAME.test(stream))
    return "a topic that names no robot";
  let message: unknown;
  try {
    message = JSON.parse(new TextDecoder().decode(payload));
  } catch {
    return "no JSON";
  }
  if (!isObject(message)) return "not an object";
  return parse(version, message, message, { robot, stream, received_ms: undefined, lambda_us: undefined });
}

interface Origin {
  readonly robot: string;
  readonly stream: string;
  readonly received_ms: number | undefined;
  readonly lambda_us: number | undefined;
}

/** What both forms have in common; `times` has the car's time of sending. */
function parse(
  version: number,
  message: Record<string, unknown>,
  times: Record<string, unknown>,
  { robot, stream, ...hops }: Origin,
): Update | string {
  const { v, boot, seq, t, next_ms = 0, sample } = message;
  if (v !== version) return "another schema version";
  if (typeof boot !== "string" || !BOOT.test(boot)) return "no boot id";
  if (!isInteger(seq) || seq < 0) return "no sequence number";
  if (!isInteger(t)) return "no sample time";
  if (!isInteger(next_ms) || next_ms < 0 || next_ms > MAX_NEXT_MS) return "no time of the next message";
  const { sent_us, offset_us = 0 } = times;
  if (!isInteger(sent_us) || !isInteger(offset_us)) return "a hop without its time";
  if (!isObject(sample)) return "no sample";
  const entries = Object.entries(sample);
  if (entries.length > MAX_FIELDS) return "too many fields";
  const values = new Map<string, Value>();
  for (const [name, value] of entries) {
    if (!FIELD_NAME.test(name)) return "a field name that is not allowed";
    if (!isValue(value)) return "a value that is neither number, text, true, false nor null";
    values.set(name, absent(name, value) ? null : value);
  }
  return {
    robot,
    stream,
    boot,
    seq,
    t_us: t,
    next_ms,
    hops: { ...hops, sent_us, offset_us, offset_known: Object.hasOwn(times, "offset_us") },
    sample: values,
  };
}

/** Whether a value means that its sensor is not fitted: Lambda 1 has put null there already. */
function absent(name: string, value: Value): boolean {
  const limit = Object.hasOwn(ABSENT_FROM, name) ? ABSENT_FROM[name] : undefined;
  return limit !== undefined && typeof value === "number" && value <= limit;
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isInteger(value: unknown): value is number {
  return Number.isSafeInteger(value);
}

function isValue(value: unknown): value is Value {
  return (
    value === null || typeof value === "boolean" || typeof value === "number" || typeof value === "string"
  );
}
