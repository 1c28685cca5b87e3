// The letters of incidents, which are marks beside the numbers of notes.

import assert from "node:assert/strict";
import { test } from "node:test";
import { path } from "../src/widgets/incident_pictures";
import { letter } from "../src/widgets/incidents_panel";

test("a line is drawn in its frame, with the edge at its time", () => {
  assert.deepEqual(path([-1, 0, 3], [0, 10, 5]), { line: "M6.0 84.0L43.0 6.0L154.0 45.0", edge: 43 });
  // What does not change is in the middle, and an edge outside of the values is in the frame, too.
  assert.deepEqual(path([2, 4], [7, 7]), { line: "M80.0 45.0L154.0 45.0", edge: 6 });
});

test("every incident has a letter of its own", () => {
  assert.deepEqual([0, 1, 25, 26, 51, 52, 701, 702].map(letter), [
    "A",
    "B",
    "Z",
    "AA",
    "AZ",
    "BA",
    "ZZ",
    "AAA",
  ]);
});
