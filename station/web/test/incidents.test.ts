// The letters of incidents, which are marks beside the numbers of notes.

import assert from "node:assert/strict";
import { test } from "node:test";
import { letter } from "../src/widgets/incidents_panel";

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
