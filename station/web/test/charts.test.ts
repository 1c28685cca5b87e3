// What the page calculates without a browser: the way from positions, and the labels of an axis.

import assert from "node:assert/strict";
import { test } from "node:test";
import { labels, roundRange } from "../src/charts/axes";
import { timeMarks } from "../src/charts/time_axis";
import { distance } from "../src/history/align";

const range = (n: number): number[] => Array.from({ length: n }, (_, i) => i);
const close = (value: number, expected: number, within: number): void =>
  assert.ok(Math.abs(value - expected) <= within, `${value} is not ${expected} ± ${within}`);
type Series = Parameters<typeof distance>[0];

test("the noise of positions is no way", () => {
  // 20 Hz: ten seconds of standing, then 10 m in ten seconds, all with 2 cm of noise.
  const times_s = range(400).map((i) => i / 20);
  const x = times_s.map((t, i) => Math.max(0, t - 10) + 0.02 * Math.sin(7 * i));
  const y = times_s.map((_, i) => 0.02 * Math.cos(11 * i));
  const way = distance(
    { times_s, fields: { x: { mean: x }, y: { mean: y } } } as unknown as Series,
    undefined,
  )!;
  assert.ok(way[200]! < 0.3);
  close(way.at(-1)!, 10, 1);
});

test("a tachometer counts samples that were taken at once, and no restart", () => {
  // 50 Hz at 5 m/s, in bursts of ten within a millisecond; then the VESC starts again from zero.
  const times_s = range(200).map((i) => Math.floor(i / 10) * 0.2 + (i % 10) / 10_000);
  // 1 m is 100 counts: at 1 m/s a minute has 6,000, of six a revolution.
  const counts = [...range(100).map((i) => 1_000_000 + 10 * i), ...range(100).map((i) => 10 * i)];
  const drive = { times_s, fields: { distance_traveled: { mean: counts } } } as unknown as Series;
  close(distance(drive, { scale: 1 / 1000, shift: 0 })!.at(-1)!, 19.8, 1e-6);
});

for (const [splits, expected] of [
  [
    [0, 2.5, 5, 7.5],
    ["0.0", "2.5", "5.0", "7.5"],
  ],
  [
    [11.75, 12, 12.25],
    ["11.75", "12.00", "12.25"],
  ],
  [
    [0, 20, 40],
    ["0", "20", "40"],
  ],
  [
    [-0.2, 0, 0.2],
    ["\u22120.2", "0.0", "0.2"],
  ],
  [
    [0, 5000, 10_000],
    ["0", "5000", "10k"],
  ],
] as const)
  test(`an axis is labelled with its values: ${splits}`, () => assert.deepEqual(labels(splits), expected));

for (const [least, most, zero, expected] of [
  // The highest value is not at the edge, though it is a round number.
  [11.9, 12.5, false, [11.8, 12.6]],
  // Zero is one, for values that do not cross it.
  [0.02, 8, true, [0, 10]],
  [-3, -1, true, [-3.5, 0]],
] as const)
  test(`an axis has room above and below ${least} to ${most}`, () => {
    const ends = roundRange(least, most, 0.1, zero);
    expected.forEach((end, i) => close(ends[i]!, end, 1e-9));
  });

const zoned = (zone: string, told: () => void): void => {
  const before = process.env.TZ;
  process.env.TZ = zone;
  try {
    told();
  } finally {
    process.env.TZ = before;
  }
};
/** The labels of a chart as wide as 80 characters. */
const marked = (from: string, span_s: number): string[] => {
  const at = Date.parse(from) / 1000;
  return timeMarks(at, at + span_s, (chars) => Math.floor(80 / (chars + 2))).map(({ label }) => label);
};
const [HOUR, DAY, YEAR] = [3600, 86_400, 31_556_952];

for (const [what, from, span_s, expected] of [
  [
    "milliseconds",
    "2026-05-04T14:03:27.013",
    0.004,
    ["14:03:27.013", "14:03:27.014", "14:03:27.015", "14:03:27.016", "14:03:27.017"],
  ],
  [
    "tenths",
    "2026-05-04T14:03:27",
    0.4,
    ["14:03:27.0", "14:03:27.1", "14:03:27.2", "14:03:27.3", "14:03:27.4"],
  ],
  [
    "seconds",
    "2026-05-04T14:03:27",
    30,
    ["14:03:30", "14:03:35", "14:03:40", "14:03:45", "14:03:50", "14:03:55"],
  ],
  [
    "minutes",
    "2026-05-04T11:58",
    1200,
    ["11:58", "12:00", "12:02", "12:04", "12:06", "12:08", "12:10", "12:12", "12:14", "12:16", "12:18"],
  ],
  [
    "the afternoon, by 24 hours",
    "2026-05-04T12:30",
    10 * HOUR,
    ["13:00", "14:00", "15:00", "16:00", "17:00", "18:00", "19:00", "20:00", "21:00", "22:00"],
  ],
  [
    "a midnight",
    "2026-05-04T22:30",
    3 * HOUR,
    ["22:30", "23:00", "23:30", "5 May", "00:30", "01:00", "01:30"],
  ],
  [
    "seconds around a midnight",
    "2026-05-04T23:59:50",
    20,
    ["23:59:50", "23:59:55", "5 May", "00:00:05", "00:00:10"],
  ],
  ["days", "2026-05-04T12:00", 7 * DAY, ["5 May", "6 May", "7 May", "8 May", "9 May", "10 May", "11 May"]],
  [
    "weeks, from Mondays",
    "2026-05-01",
    60 * DAY,
    ["4 May", "11 May", "18 May", "25 May", "1 Jun", "8 Jun", "15 Jun", "22 Jun", "29 Jun"],
  ],
  [
    "months and a new year",
    "2026-09-10",
    300 * DAY,
    ["Oct", "Nov", "Dec", "2027", "Feb", "Mar", "Apr", "May", "Jun", "Jul"],
  ],
  ["years", "2020-06-01", 8 * YEAR, ["2021", "2022", "2023", "2024", "2025", "2026", "2027", "2028"]],
  [
    "decades",
    "1995-06-01",
    90 * YEAR,
    ["2000", "2010", "2020", "2030", "2040", "2050", "2060", "2070", "2080"],
  ],
] as const)
  test(`an axis of time is marked at whole ${what}`, () =>
    zoned("UTC", () => assert.deepEqual(marked(from, span_s), expected)));

test("every range of time has several labels, in their order, and as many as have room", () => {
  for (const zone of ["UTC", "Asia/Kolkata", "America/St_Johns"])
    zoned(zone, () => {
      const from = Date.parse("2026-05-04T10:17:31.237Z") / 1000;
      for (let span = 0.01; span < 300 * YEAR; span *= 1.13)
        for (const width of [45, 80, 160]) {
          const marks = timeMarks(from, from + span, (chars) => Math.floor(width / (chars + 2)));
          const told = `${zone} ${span} s, ${width}: ${marks.map(({ label }) => label).join(" ")}`;
          assert.ok(marks.length >= 2 || width < 80, told);
          // Hours come again on the next day, and months in the next year.
          if (span < DAY || (span > 14 * DAY && span < 0.9 * YEAR) || span > 12 * YEAR)
            assert.equal(new Set(marks.map(({ label }) => label)).size, marks.length, told);
          assert.ok(
            marks.every(({ at }, i) => at >= from && (i === 0 || at > marks[i - 1]!.at)),
            told,
          );
          assert.ok(marks.at(-1) === undefined || marks.at(-1)!.at <= from + span, told);
          assert.ok(marks.reduce((sum, { label }) => sum + label.length + 1, 0) <= width + 12, told);
        }
    });
});

test("hours stay whole where the clocks change", () => {
  zoned("Europe/Berlin", () => {
    assert.deepEqual(marked("2026-03-29T00:00+01:00", 8 * HOUR), [
      ...["29 Mar", "01:00", "03:00", "04:00", "05:00", "06:00", "07:00", "08:00", "09:00"],
    ]);
    assert.deepEqual(marked("2026-03-27T12:00+01:00", 10 * DAY), [
      "28 Mar",
      "29 Mar",
      "30 Mar",
      "31 Mar",
      "1 Apr",
      "2 Apr",
      "3 Apr",
      "4 Apr",
      "5 Apr",
      "6 Apr",
    ]);
  });
});
