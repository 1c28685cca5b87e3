// The analysed drives, and those that could not be analysed, with the reason.

import type { DriveEntry } from "../base/contract";
import { el, table } from "../base/dom";
import { age, number, when } from "../base/format";
import { writeTime } from "../base/range";
import { route } from "../base/route";

const ROWS = 20;

/** `robot` is undefined for the fleet's drives; `chosen` is the start of the one whose laps are shown. */
export function drivesTable(
  drives: readonly DriveEntry[],
  robot: string | undefined,
  chosen: number | undefined,
): HTMLElement {
  const head = [
    ...(robot === undefined ? ["Robot"] : []),
    "Start",
    "Length",
    "Samples",
    "Repaired",
    robot === undefined ? "Result" : "Laps",
  ];
  const rows = drives
    .slice(0, ROWS)
    .map((drive) => row(drive, robot === undefined, drive.from_us === chosen));
  const failed = drives.filter((drive) => drive.failed !== "").length;
  const title = `Drives: ${drives.length}${failed > 0 ? `, ${failed} could not be analysed` : ""}`;
  return el(
    "section",
    { class: "panel drives", "aria-label": "Drives" },
    el("h3", {}, title),
    el("div", { class: "log" }, table(head, el("tbody", {}, ...rows))),
  );
}

function row(drive: DriveEntry, named: boolean, chosen: boolean): HTMLElement {
  const { robot, from_us, to_us, samples, failed, repairs, estimates } = drive;
  const [from, to] = [from_us / 1e6, to_us / 1e6];
  const query = { from: writeTime(from), to: writeTime(to) };
  const at = el("a", { href: route({ view: "history", robot, query }) }, when(from));
  const repaired = Object.entries(repairs).map(
    ([kind, count]) => `${kind.replaceAll("_", " ")} ${number(count)}`,
  );
  const best = estimates.lap_best_s;
  const laps = el(
    "a",
    {
      class: "tool",
      href: route({ view: "insights", robot, query: { drive: writeTime(from) } }),
      ...(chosen ? { "aria-current": "true" } : {}),
    },
    best ? `best ${number(best.value, 2)} s` : "look for laps",
  );
  const result = failed === "" ? (named ? "analysed" : laps) : failed;
  return el(
    "tr",
    { "data-failed": String(failed !== "") },
    ...(named
      ? [el("th", { scope: "row" }, el("a", { href: route({ view: "insights", robot }) }, robot))]
      : []),
    el("td", {}, at),
    el("td", {}, age(to - from)),
    el("td", { "data-head": "samples" }, number(samples)),
    el("td", { "data-head": "repaired" }, repaired.join(", ") || "none"),
    el("td", failed === "" ? {} : { class: "words" }, result),
  );
}
