// Ranges of time, and how an address writes them: 2026-05-04T10:00:00.000Z.

import type { Extent } from "./contract";

export type Range = readonly [from_s: number, to_s: number];

/** The shortest range that can be shown. */
export const LEAST_S = 0.01;
// Years of four digits, as ISO 8601 has them.
const MOST_S = 253402300799;

export function writeTime(at_s: number): string {
  return new Date(Math.round(at_s * 1000)).toISOString();
}

/** NaN for a text that is not a time. */
export function readTime(text: string | undefined): number {
  const at_s = text === undefined ? NaN : Date.parse(text) / 1000;
  return at_s >= 0 && at_s <= MOST_S ? at_s : NaN;
}

/** A range from two texts; undefined unless both are times, in order. */
export function readRange(from: string | undefined, to: string | undefined): Range | undefined {
  const range = [readTime(from), readTime(to)] as const;
  return range[1] - range[0] >= LEAST_S ? range : undefined;
}

export const same = (one: Range | undefined, other: Range | undefined): boolean =>
  one === other || (one !== undefined && other !== undefined && one[0] === other[0] && one[1] === other[1]);

/** The range with ends at whole milliseconds, as an address has them. */
export const rounded = ([from, to]: Range): Range => [
  Math.floor(from * 1000) / 1000,
  Math.ceil(to * 1000) / 1000,
];

/** The ends as the server's questions have them. */
export const inUs = ([from, to]: Range): { readonly from_us: string; readonly to_us: string } => ({
  from_us: String(Math.round(from * 1e6)),
  to_us: String(Math.round(to * 1e6)),
});

export const rangeOf = ({ from_us, to_us }: Extent): Range => rounded([from_us / 1e6, to_us / 1e6]);

/** The last of the rising times that is not after a time; the first one if all are. */
export function lastAt(times: ArrayLike<number>, at: number): number {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle]! <= at + 1e-6) low = middle + 1;
    else high = middle;
  }
  return Math.min(times.length - 1, Math.max(0, low - 1));
}
