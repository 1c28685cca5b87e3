// The marks of an axis of time, in the device's time zone: from a millisecond to centuries, by 24 hours, with the date
// where a day begins.

/** A distance of marks. `s` is its length, about. */
interface Step {
  readonly s: number;
  /** The characters of its longest label. */
  readonly chars: number;
  /** The marks in a range, in seconds. */
  readonly marks: (from_s: number, to_s: number) => number[];
  readonly label: (at: Date) => string;
}

const DAY_MS = 86_400_000;
const MONTHS = "Jan Feb Mar Apr May Jun Jul Aug Sep Oct Nov Dec".split(" ");
const two = (value: number): string => String(value).padStart(2, "0");
const clock = (at: Date): string => `${two(at.getHours())}:${two(at.getMinutes())}`;
const month = (at: Date): string => MONTHS[at.getMonth()]!;
const date = (at: Date): string => `${at.getDate()} ${month(at)}`;
const midnight = (at: Date): boolean => at.getHours() + at.getMinutes() + at.getSeconds() === 0;
const dated =
  (time: (at: Date) => string) =>
  (at: Date): string =>
    midnight(at) && at.getMilliseconds() === 0 ? date(at) : time(at);

/** Steps that divide an hour: they begin at a whole one. */
function within(s: number): Step {
  const digits = s >= 1 ? 0 : s >= 0.1 ? 1 : s >= 0.01 ? 2 : 3;
  const time = (at: Date): string => {
    const fraction = String(at.getMilliseconds()).padStart(3, "0").slice(0, digits);
    return `${clock(at)}${s < 60 ? `:${two(at.getSeconds())}` : ""}${digits ? `.${fraction}` : ""}`;
  };
  // A thousandth has no exact number, but a thousand has.
  const each = s < 1 ? Math.round(1 / s) : 1 / s;
  return {
    s,
    chars: (s < 60 ? 8 : 6) + (digits ? digits + 1 : 0),
    marks: (from, to) => {
      const east = -60 * new Date(from * 1000).getTimezoneOffset();
      const first = Math.ceil((from + east) * each - 1e-3);
      const count = Math.floor((to + east) * each + 1e-3) - first + 1;
      return Array.from({ length: Math.max(0, count) }, (_, i) => (first + i) / each - east);
    },
    label: dated(time),
  };
}

/** Steps of the calendar: `nth` is the date of a number, which grows with the time, and `number` that of a date. */
function calendar(
  s: number,
  chars: number,
  label: (at: Date) => string,
  number: (at: Date) => number,
  nth: (number: number, at: Date) => Date,
  each: number,
): Step {
  return {
    s: s * each,
    chars,
    label,
    marks: (from, to) => {
      const begin = new Date(from * 1000);
      const marks: number[] = [];
      for (let i = Math.floor(number(begin) / each) * each; ; i += each) {
        const at = nth(i, begin).getTime() / 1000;
        if (at > to) return marks;
        // The hour that a change of the clocks leaves out is the next one.
        if (at >= from && at !== marks.at(-1)) marks.push(at);
      }
    },
  };
}

const day = (at: Date): number => Date.UTC(at.getFullYear(), at.getMonth(), at.getDate()) / DAY_MS;
/** The first day that was a Monday, so that weeks begin there. */
const MONDAY = 4;
const hours = (each: number): Step =>
  calendar(
    3600,
    6,
    dated(clock),
    (at) => at.getHours(),
    (hour, at) => new Date(at.getFullYear(), at.getMonth(), at.getDate(), hour),
    each,
  );
const days = (each: number): Step =>
  calendar(
    DAY_MS / 1000,
    6,
    date,
    (at) => day(at) - MONDAY,
    (number) => {
      const at = new Date((number + MONDAY) * DAY_MS);
      return new Date(at.getUTCFullYear(), at.getUTCMonth(), at.getUTCDate());
    },
    each,
  );
const months = (each: number): Step =>
  calendar(
    30 * (DAY_MS / 1000),
    4,
    (at) => (at.getMonth() === 0 ? String(at.getFullYear()) : month(at)),
    (at) => at.getFullYear() * 12 + at.getMonth(),
    (number) => new Date(0, number - 1900 * 12),
    each,
  );
const years = (each: number): Step =>
  calendar(
    365 * (DAY_MS / 1000),
    4,
    (at) => String(at.getFullYear()),
    (at) => at.getFullYear(),
    (year) => new Date(0, (year - 1900) * 12),
    each,
  );

const STEPS: readonly Step[] = [
  ...[1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5].map(within),
  ...[1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800].map(within),
  ...[1, 2, 3, 6, 12].map(hours),
  ...[1, 2, 4, 7, 14].map(days),
  ...[1, 3, 6].map(months),
  ...[1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].map(years),
];

export interface Mark {
  readonly at: number;
  readonly label: string;
}

/** The marks of a range that have room: `room` is how many labels of so many characters fit. */
export function timeMarks(from_s: number, to_s: number, room: (chars: number) => number): Mark[] {
  const step = STEPS.find(({ s, chars }) => (to_s - from_s) / s <= Math.max(1, room(chars))) ?? STEPS.at(-1)!;
  return step.marks(from_s, to_s).map((at) => ({ at, label: step.label(new Date(Math.round(at * 1000))) }));
}
