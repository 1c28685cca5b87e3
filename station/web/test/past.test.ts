// What the page makes of several streams without a browser: one axis of time, and values joined to other times.

import assert from "node:assert/strict";
import { test } from "node:test";
import { FIELD_TABLE, type HistoryAnswer } from "../src/base/contract";
import { clockTime, dayTime, when } from "../src/base/format";
import { lastAt } from "../src/base/range";
import { together } from "../src/history/chart";
import { Past } from "../src/history/past";
import { harmless } from "../src/history/rows_panel";
import type { Fleet } from "../src/live/fleet";

const fleet = { speed: () => undefined } as unknown as Fleet;
const answer = (times_s: number[], fields: Readonly<Record<string, number[]>>, row_s = 0): HistoryAnswer =>
  ({
    times_s,
    row_s,
    ros2: false,
    fields: Object.fromEntries(Object.entries(fields).map(([name, mean]) => [name, { mean }])),
  }) as unknown as HistoryAnswer;
const past = (drives: Readonly<Record<string, HistoryAnswer>>, known = {}): Past =>
  new Past(FIELD_TABLE, fleet, "car", "vesc", known, new Map(Object.entries(drives)));

test("a time has the last row that is not after it", () => {
  assert.deepEqual(
    [0, 1, 1.5, 2, 9].map((at) => lastAt([1, 2, 3], at)),
    [0, 0, 0, 1, 2],
  );
  assert.equal(lastAt([], 1), -1);
});

test("columns of two streams share an axis, and neither has a gap where only the other has a row", () => {
  const merged = together([
    { x: [0, 1, 2], y: [10, null, 12] },
    { x: [0.5, 1], y: [20, 21] },
  ]);
  assert.deepEqual(merged.x, [0, 0.5, 1, 2]);
  // A missing value is a gap; a row of the other stream is none.
  assert.deepEqual(merged.columns, [
    [10, undefined, null, 12],
    [undefined, 20, 21, undefined],
  ]);
  const x = [0, 1];
  assert.equal(
    together([
      { x, y: [1, 2] },
      { x, y: [3, 4] },
    ]).x,
    x,
  );
});

test("a field is joined to the last sample before, and not across a gap", () => {
  const drives = {
    vesc: answer([0, 1, 2], { speed: [5, 6, 7] }),
    pose: answer([0.4, 0.9, 10], { x: [1, 2, 3] }),
  };
  assert.deepEqual(past(drives).joined("pose/x", [0, 0.5, 1, 1.8, 2.5, 10]), [NaN, 1, 2, 2, NaN, 3]);
  assert.deepEqual(past(drives).joined("speed", drives.vesc.times_s), [5, 6, 7]);
  assert.deepEqual(past(drives).joined("pose/nothing", [1]), [NaN]);
});

test("latitudes and longitudes are metres from the first fix, also at the date line", () => {
  const known = { gps: { numbers: [], position: ["latitude", "longitude"], degrees: true } };
  const gps = answer([0, 1, 2, 3], {
    latitude: [0, 60, 60.0001, 60],
    longitude: [0, 179.9999, 179.9999, -179.9999],
  });
  const { x, y } = past({ gps }, known).place("gps")!;
  assert.deepEqual([x[0], y[0], x[1], y[1]], [NaN, NaN, 0, 0]);
  assert.ok(Math.abs(y[2]! - 11.12) < 0.01 && Math.abs(x[2]!) < 1e-6);
  assert.ok(Math.abs(x[3]! - 11.12) < 0.01, String(x[3]));
});

test("a key without a stream is of the main one", () => {
  const of = past({ vesc: answer([0], { speed: [1] }), pose: answer([0], { x: [2] }) });
  assert.deepEqual(of.parse("speed"), ["vesc", "speed"]);
  assert.deepEqual(of.parse("pose/x"), ["pose", "x"]);
  assert.deepEqual([of.key("vesc", "speed"), of.key("pose", "x")], ["speed", "pose/x"]);
  assert.equal(of.label("pose/x"), "X, pose");
});

test("a robot's text is no formula in what is copied", () => {
  for (const text of ["=1+1", "@SUM(A1)", "+1", "-1", " \t=1", "\r\n=1", "\uff1d1"])
    assert.equal(harmless(text), `'${text}`);
  for (const text of ["", "idle", "a=1", "1-2", "'=1"]) assert.equal(harmless(text), text);
});

test("a time that no calendar has is written as nothing, and not an error", () => {
  assert.match(dayTime(1_700_000_000, { fractionalSecondDigits: 1 }), /^Tue 14 Nov \d\d:\d\d:20\.0$/);
  assert.match(clockTime(1_700_000_000), /^\d\d:\d\d:20$/);
  for (const at of [NaN, Infinity, -1e300, 8.65e12]) assert.match(when(at), /^– – \S+/);
});
