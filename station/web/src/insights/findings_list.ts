// What the analysis found: what changed, by how much, what to do, and where to look.

import { ANALYSIS_FAILED, type FindingEntry } from "../base/contract";
import { el, marked } from "../base/dom";
import { capital, number, when } from "../base/format";
import { writeTime } from "../base/range";
import { route } from "../base/route";
import { changed, intervalBar, words } from "./figures";

const SEVERITIES = { serious: 0, warning: 1, info: 2 } as const;

/** The findings, the serious ones first and then the newest; `named` tells whose each is. */
export function findingsList(findings: readonly FindingEntry[], named: boolean): HTMLElement {
  // The list of drives has those that failed.
  const shown = findings
    .filter(({ kind }) => kind !== ANALYSIS_FAILED)
    .sort((a, b) => SEVERITIES[a.severity] - SEVERITIES[b.severity] || b.from_us - a.from_us);
  return el("ul", { class: "findings" }, ...shown.map((finding) => item(finding, named)));
}

function item(finding: FindingEntry, named: boolean): HTMLElement {
  const { robot, kind, severity, meaning, action, text, stream, fields, q, effect, from_us, to_us } = finding;
  const [from, to] = [from_us / 1e6, to_us / 1e6];
  const query = {
    ...(stream ? { stream } : {}),
    from: writeTime(from),
    to: writeTime(Math.max(to, from + 1)),
    ...(fields.length > 0 ? { fields: fields.join(",") } : {}),
  };
  const share = (q: number): string => (q < 1e-5 ? "less than 0.001" : number(q * 100, q < 0.001 ? 3 : 1));
  const title = "The share of false findings among those that count as sure as this one";
  const chance = (q: number): HTMLElement =>
    el("span", { class: "note", title }, `false alarms: ${share(q)} % of such findings`);
  return el(
    "li",
    { class: "panel finding", "data-severity": severity, "data-kind": kind },
    el(
      "header",
      {},
      el("h3", {}, capital(meaning)),
      el("span", { class: "severity" }, severity),
      ...(named ? [el("a", { class: "tool", href: route({ view: "insights", robot }) }, robot)] : []),
      el("span", { class: "note" }, when(from)),
    ),
    el("p", {}, ...marked(capital(text))),
    ...(effect ? [size(finding)] : []),
    el("p", {}, el("b", {}, "What to do: "), ...marked(action)),
    el(
      "p",
      { class: "seen" },
      el("a", { class: "tool", href: route({ view: "history", robot, query }) }, "Show the evidence"),
      ...(q === null ? [] : [chance(q)]),
    ),
  );
}

function size({ effect, baseline }: FindingEntry): HTMLElement {
  const now = baseline ? changed(baseline, effect!) : effect!;
  const told = baseline
    ? [`now ${words(now)}`, `usually ${words(baseline)}`, `change ${words(effect!, true)}`]
    : [words(now)];
  return el(
    "div",
    { class: "effect" },
    intervalBar(now, baseline),
    el("ul", { class: "legend" }, ...told.map((each) => el("li", {}, each))),
  );
}
