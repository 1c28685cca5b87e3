// Formats values: unit, scale and digits follow from the contract's field table.

import type { FieldTable, Value } from "./contract";

/** The shown value is the sent value times `scale`, plus `shift`. */
export interface Linear {
  readonly scale: number;
  readonly shift: number;
}

export const AS_SENT: Linear = { scale: 1, shift: 0 };
export const times = (scale: number): Linear => ({ scale, shift: 0 });
export const linear = (value: number, { scale, shift }: Linear): number => value * scale + shift;
/** A column's numbers as they are shown; what is none is null. */
export const numbers = (values: readonly Value[], as: Linear): (number | null)[] =>
  values.map((value) => (typeof value === "number" ? linear(value, as) : null));

export interface Spec extends Linear {
  readonly label: string;
  readonly meaning: string;
  readonly unit: string;
  /** Digits after the point, where fixed. */
  readonly digits: number | undefined;
  readonly texts?: Readonly<Record<string, string>>;
  /** The value is a time, in microseconds since 1970. */
  readonly time?: boolean;
}

export const NOTHING = "–";

// The units by their digits after the point: none, one, and so on.
const UNITS_OF_DIGITS = [
  ["erpm", "counts", "id", "ms", "batches", "bytes"],
  ["degC", "deg", "W", "%", "MB"],
  ["V", "A", "m/s", "m/s^2", "rad/s", "m"],
  ["Wh", "rad"],
  ["Ah"],
];
const DIGITS: Readonly<Record<string, number>> = Object.fromEntries(
  UNITS_OF_DIGITS.flatMap((units, digits) => units.map((unit) => [unit, digits])),
);
const UNITS: Readonly<Record<string, string>> = { degC: "°C", deg: "°", enum: "", id: "", "m/s^2": "m/s²" };
const CAPITALS = new Set("pcb fet ntc pid id iq vd vq imu gps cpu mos1 mos2 mos3".split(" "));

/** The paths of positions in geometry_msgs, nav_msgs and tf2_msgs, and in flat messages. */
export const POSITIONS =
  "pose.pose.position. pose.position. position. transform.translation. translation. pose."
    .split(" ")
    .concat("");

/** The format of a field of a stream; `ros2` selects the ROS 2 driver's units. */
export function spec(field: string, table: FieldTable, ros2 = false, stream = ""): Spec {
  const fields = (Object.hasOwn(table.streams, stream) ? table.streams[stream] : undefined) ?? table.fields;
  const known = Object.hasOwn(fields, field) ? fields[field] : undefined;
  const label = known?.label ?? humanise(field);
  if (!known) {
    const plain = rosUnit(field, table);
    return { label, meaning: "", unit: UNITS[plain] ?? plain, ...AS_SENT, digits: DIGITS[plain] };
  }
  const { meaning } = known;
  const unit = (ros2 ? known.ros2_unit : undefined) ?? known.unit;
  if (field === "fault_code")
    return { label, meaning: "", unit: "", ...AS_SENT, digits: 0, texts: table.faults };
  if (unit === "us") return { label, meaning, unit: "", ...AS_SENT, digits: 0, time: true };
  // Shares are shown in percent, and 1e-4 Ah in Ah.
  if (unit === "1") return { label, meaning, unit: "%", ...times(100), digits: 1 };
  const scaled = /^1e(-?\d+) (.+)$/.exec(unit);
  const plain = scaled ? scaled[2]! : unit;
  return {
    label,
    meaning,
    unit: UNITS[plain] ?? plain,
    ...times(scaled ? 10 ** Number(scaled[1]) : 1),
    digits: DIGITS[plain],
  };
}

function rosUnit(field: string, { ros_units }: FieldTable): string {
  const within = /^(.+)\.[xyz]$/.exec(field)?.[1];
  const name =
    within && Object.keys(ros_units).find((each) => within === each || within.endsWith(`.${each}`));
  return name ? ros_units[name]! : "";
}

/** The format of the motor's speed as the car's speed, if the car's parameters are known; else `spec`. */
export function asSpeed(field: string, spec: Spec, speed: Linear | undefined): Spec {
  return field === "speed" && spec.unit === "erpm" && speed
    ? { ...spec, ...speed, unit: "m/s", digits: 2 }
    : spec;
}

export function write(value: Value | undefined, spec: Spec): string {
  const { digits, texts, time } = spec;
  if (value === null || value === undefined) return NOTHING;
  if (time && typeof value === "number") return when(value / 1e6);
  if (typeof value === "number") return texts?.[String(value)] ?? number(linear(value, spec), digits);
  return String(value);
}

/** A number with a real minus sign, and thin spaces between thousands. */
export function number(value: number, digits?: number): string {
  if (!Number.isFinite(value)) return NOTHING;
  const magnitude = Math.abs(value);
  let text: string;
  if (digits !== undefined && magnitude < 1e12) text = magnitude.toFixed(digits);
  else if (magnitude !== 0 && (magnitude >= 1e12 || magnitude < 1e-4)) text = magnitude.toExponential(3);
  else
    text = Number.isInteger(magnitude) ? String(magnitude) : magnitude.toPrecision(6).replace(/\.?0+$/, "");
  const [whole = "", rest] = text.split(".");
  if (whole.length > 4 && !text.includes("e"))
    text = whole.replace(/\B(?=(\d{3})+$)/g, "\u202f") + (rest ? `.${rest}` : "");
  return value < 0 && /[1-9]/.test(text) ? `\u2212${text}` : text;
}

/** An age or a duration: 0.3 s, 12 s, 3 min, 2 h. */
export function age(seconds: number): string {
  if (seconds < 9.95) return `${Math.max(0, seconds).toFixed(1)} s`;
  if (seconds < 99.5) return `${seconds.toFixed(0)} s`;
  return seconds < 5940 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(0)} h`;
}

export function milliseconds(value: number): string {
  return number(value, Math.abs(value) < 9.95 ? 1 : 0);
}

export function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function humanise(field: string): string {
  const words = field.split(/[_.]/).map((word) => (CAPITALS.has(word) ? word.toUpperCase() : word));
  return capital(words.join(" "));
}

/** Formats of times, each made once: that takes a hundred times as long as a text by it. */
const formats = new Map<string, Intl.DateTimeFormat>();
const DAY = { weekday: "short", day: "numeric", month: "short" } as const;
const TIME = { hour: "2-digit", minute: "2-digit", second: "2-digit" } as const;
// No date is further from 1970.
const MOST_S = 8.64e12;

function timeFormat(options: Intl.DateTimeFormatOptions): Intl.DateTimeFormat {
  const key = JSON.stringify(options);
  let format = formats.get(key);
  if (!format) formats.set(key, (format = new Intl.DateTimeFormat("en-GB", options)));
  return format;
}

const timeText = (seconds: number, options: Intl.DateTimeFormatOptions): string =>
  Math.abs(seconds) <= MOST_S ? timeFormat(options).format(seconds * 1000) : NOTHING;

/** This device's time zone at a time: UTC, CET, GMT+2. */
export function zone(seconds: number): string {
  const at = Math.abs(seconds) <= MOST_S ? seconds * 1000 : undefined;
  const parts = timeFormat({ timeZoneName: "short" }).formatToParts(at);
  return parts.find(({ type }) => type === "timeZoneName")?.value ?? "local time";
}

/** The local time of day: 14:03:27. */
export const clockTime = (seconds: number): string => timeText(seconds, TIME);

/** The local time of day, with the date unless it is today: Fri 20 Nov 14:03:27. */
export function dayTime(seconds: number, options: Intl.DateTimeFormatOptions = {}): string {
  const today = new Date(seconds * 1000).toDateString() === new Date().toDateString();
  return `${today ? "" : `${timeText(seconds, DAY)} `}${timeText(seconds, { ...TIME, ...options })}`;
}

/** As `dayTime`, with the time zone: Fri 20 Nov 14:03:27 CET. */
export function when(seconds: number, options: Intl.DateTimeFormatOptions = {}): string {
  return `${dayTime(seconds, options)} ${zone(seconds)}`;
}
