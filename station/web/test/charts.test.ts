// What the page calculates without a browser: the way from positions, and the labels of an axis.

import assert from "node:assert/strict";
import { test } from "node:test";
import { labels, roundRange, TIME_STEPS_S } from "../src/charts/axes";
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

test("every range of time has several labels", () => {
  const ratios = TIME_STEPS_S.slice(1).map((step, i) => step / TIME_STEPS_S[i]!);
  assert.ok(Math.max(...ratios) <= 2.5);
});
