// A live message as the car sends it to the broker, as far as a driver needs it.

import { DRIVE_STREAM, SCHEMA_VERSION } from "../base/contract";

/** Who drives, by a sample of the stream `DRIVE_STREAM`. */
export interface Driven {
  readonly session: string;
  readonly seq: number;
  readonly outcome: string;
  readonly driver: string;
  readonly driverBy: string;
  readonly leaseLeft_ms: number;
}

export interface LiveMessage {
  /** When the sample was taken and when it left the car, by the cloud's clock; undefined if the car does not know it. */
  readonly taken_ms: number | undefined;
  readonly sent_ms: number | undefined;
  /** How long the sample lay in the car. */
  readonly lay_ms: number;
  readonly driven: Driven | undefined;
}

/** The message of a topic live/<namespace>/<robot>/<stream>; undefined for anything else. */
export function readLive(topic: string, payload: string): LiveMessage | undefined {
  let message: unknown;
  try {
    message = JSON.parse(payload);
  } catch {
    return undefined;
  }
  if (!isObject(message)) return undefined;
  const { v, t, sent_us, offset_us, sample } = message;
  if (v !== SCHEMA_VERSION || !isInteger(t) || !isInteger(sent_us) || !isObject(sample)) return undefined;
  const cloud = (us: number): number | undefined =>
    isInteger(offset_us) ? (us + offset_us) / 1e3 : undefined;
  return {
    taken_ms: cloud(t),
    sent_ms: cloud(sent_us),
    lay_ms: Math.max(0, (sent_us - t) / 1e3),
    driven: topic.split("/")[3] === DRIVE_STREAM ? drivenOf(sample) : undefined,
  };
}

function drivenOf({
  session,
  seq,
  outcome,
  driver,
  driver_by,
  lease_left_ms,
}: Readonly<Record<string, unknown>>): Driven | undefined {
  if (typeof session !== "string" || !isInteger(seq) || typeof outcome !== "string") return undefined;
  const text = (value: unknown): string => (typeof value === "string" ? value : "");
  return {
    session,
    seq,
    outcome,
    driver: text(driver),
    driverBy: text(driver_by),
    leaseLeft_ms: typeof lease_left_ms === "number" ? lease_left_ms : 0,
  };
}

function isObject(value: unknown): value is Readonly<Record<string, unknown>> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isInteger(value: unknown): value is number {
  return Number.isSafeInteger(value);
}
