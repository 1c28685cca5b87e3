// What a viewer asks a car's camera for and what comes back, as `iort_contract.messages.video` writes it;
// tests/unit/contract/video.json tests both. A message that is none of these is undefined.

import {
  MAX_SDP_BYTES,
  PICTURE,
  PICTURE_MAX_AGE_MS,
  SCHEMA_VERSION,
  TO,
  VIDEO,
  VIEW,
  VIEW_LEASE_MS,
  type VideoTermsEntry,
} from "../base/contract";

export interface IceServer {
  readonly urls: readonly string[];
  readonly username?: string;
  readonly credential?: string;
}

export interface Look {
  readonly viewer: string;
  readonly request: string;
  readonly kind: "ask" | "offer" | "pictures" | "keep" | "end";
  readonly sdp?: string;
  readonly ice_servers?: readonly IceServer[];
}

export interface Show {
  readonly request: string;
  readonly kind: "terms" | "answer" | "refused" | "ended";
  readonly why: string;
  readonly sdp: string;
  readonly terms: VideoTermsEntry | undefined;
  readonly ice_servers: readonly IceServer[];
}

/** A picture's number in this run of the car's agent, and its capture by the car's clock; with WebRTC its RTP time. */
export interface Mark {
  readonly number: number;
  readonly captured_ms: number;
  readonly rtp: number;
}

export interface Picture extends Omit<Mark, "rtp"> {
  readonly sent_ms: number;
  readonly jpeg: Uint8Array<ArrayBuffer>;
}

export interface Topics {
  readonly look: string;
  readonly picture: string;
  readonly answer: (viewer: string) => string;
}

export function topicsOf(namespace: string, robot: string): Topics {
  const topic = (name: string): string => [VIEW, namespace, robot, name].join("/");
  return { look: topic(VIDEO), picture: topic(PICTURE), answer: (viewer) => topic(TO + viewer) };
}

export const encodeLook = (look: Look): object => ({ v: SCHEMA_VERSION, lease_ms: VIEW_LEASE_MS, ...look });

export function decodeShow(payload: Uint8Array): Show | undefined {
  let show: unknown;
  try {
    show = JSON.parse(new TextDecoder().decode(payload));
  } catch {
    return undefined;
  }
  if (!isObject(show)) return undefined;
  const { v, request, kind, why = "", sdp = "", terms, ice_servers = [] } = show;
  if (v !== SCHEMA_VERSION || typeof request !== "string" || typeof why !== "string") return undefined;
  if (kind !== "terms" && kind !== "answer" && kind !== "refused" && kind !== "ended") return undefined;
  if (typeof sdp !== "string" || sdp.length > MAX_SDP_BYTES || (sdp !== "") !== (kind === "answer"))
    return undefined;
  if (!Array.isArray(ice_servers) || !ice_servers.every(isServer)) return undefined;
  if (terms !== undefined && terms !== null && !isTerms(terms)) return undefined;
  if (kind === "terms" && !terms) return undefined;
  // A message leaves out what is as usual.
  const whole = terms ? { ...terms, max_age_ms: terms.max_age_ms ?? PICTURE_MAX_AGE_MS } : undefined;
  return { request, kind, why, sdp, terms: whole, ice_servers };
}

// Binary messages begin with their kind. Numbers are big-endian, times microseconds.
const [MARKS, PING, ECHO, JPEG] = [1, 2, 3, 4];
const [MARK_BYTES, PING_BYTES, ECHO_BYTES, HEAD_BYTES] = [16, 5, 13, 29];

/** The marks in a message of the data channel, the newest last. */
export function decodeMarks(message: ArrayBuffer): Mark[] | undefined {
  const view = new DataView(message);
  if (view.byteLength < 1 || view.getUint8(0) !== MARKS || (view.byteLength - 1) % MARK_BYTES)
    return undefined;
  return Array.from({ length: (view.byteLength - 1) / MARK_BYTES }, (_, i) => {
    const at = 1 + i * MARK_BYTES;
    return { number: view.getUint32(at), captured_ms: time_ms(view, at + 4), rtp: view.getUint32(at + 12) };
  });
}

/** A question for the car's clock, on the data channel. */
export function askClock(number: number): ArrayBuffer {
  const message = new ArrayBuffer(PING_BYTES);
  const view = new DataView(message);
  view.setUint8(0, PING!);
  view.setUint32(1, number);
  return message;
}

/** The number of the question, and the car's time when it answered. */
export function decodeClock(
  message: ArrayBuffer,
): { readonly number: number; readonly robot_ms: number } | undefined {
  const view = new DataView(message);
  return view.byteLength === ECHO_BYTES && view.getUint8(0) === ECHO
    ? { number: view.getUint32(1), robot_ms: time_ms(view, 5) }
    : undefined;
}

/** A picture over the broker. */
export function decodePicture(message: Uint8Array): Picture | undefined {
  const view = new DataView(message.buffer, message.byteOffset, message.byteLength);
  if (view.byteLength <= HEAD_BYTES || view.getUint8(0) !== JPEG) return undefined;
  return {
    number: view.getUint32(1),
    captured_ms: time_ms(view, 5),
    sent_ms: time_ms(view, 13),
    jpeg: new Uint8Array(message.subarray(HEAD_BYTES)),
  };
}

const time_ms = (view: DataView, at: number): number => Number(view.getBigInt64(at)) / 1e3;

const isObject = (value: unknown): value is Readonly<Record<string, unknown>> =>
  typeof value === "object" && value !== null && !Array.isArray(value);

const isServer = (value: unknown): value is IceServer =>
  isObject(value) &&
  Array.isArray(value.urls) &&
  value.urls.every((url) => typeof url === "string" && /^(stun|turns?):/.test(url)) &&
  ["string", "undefined"].includes(typeof value.username) &&
  ["string", "undefined"].includes(typeof value.credential);

const isTerms = (value: unknown): value is VideoTermsEntry =>
  isObject(value) &&
  [value.width, value.height, value.rate_hz, value.max_age_ms ?? 1].every(
    (number) => typeof number === "number" && Number.isFinite(number) && number > 0,
  );
