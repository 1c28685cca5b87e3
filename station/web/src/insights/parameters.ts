// The car's parameters over its drives: a card each, with the newest value, its interval, and a chart.

import type { DriveEntry, FindingEntry, InsightsAnswer, ParameterEntry } from "../base/contract";
import { el } from "../base/dom";
import { capital, number } from "../base/format";
import { RangeChart } from "../charts/range_chart";
import { digits, intervalBar, scale, words } from "./figures";

const DAY_S = 86_400;
// The charts' room around the first and the last drive, as a share of the time between them.
const MARGIN = 0.04;
const wide = (): boolean => window.matchMedia("(min-width: 48rem)").matches;

export class Parameters {
  readonly node = el("div", { class: "insights-groups" });
  private charts: RangeChart[] = [];

  /** Show the parameters of drives, the newest first. */
  show({ drives, groups, findings }: InsightsAnswer): void {
    this.clear();
    const sound = drives.filter(({ failed }) => failed === "");
    for (const [group, parameters] of Object.entries(groups)) {
      const known = Object.entries(parameters).filter(([name]) =>
        sound.some(({ estimates }) => Object.hasOwn(estimates, name)),
      );
      const lacking = Object.keys(parameters).flatMap((name) =>
        sound[0]?.missing[name] ? [[parameters[name]!.meaning, sound[0].missing[name]] as const] : [],
      );
      if (known.length === 0 && lacking.length === 0) continue;
      const cards = el("div", { class: "parameters" });
      const count = el("span", { class: "note" }, ` ${known.length}`);
      const fold = el(
        "details",
        {},
        el("summary", { class: "group-name" }, el("h3", {}, group), count),
        cards,
        ...(lacking.length > 0 ? [missing(lacking)] : []),
      );
      this.node.append(fold);
      for (const [name, parameter] of known) this.card(cards, name, parameter, sound, findings);
      // A narrow screen shows what has changed.
      fold.open = wide() || cards.querySelector("[data-severity]:not([data-severity=''])") !== null;
    }
  }

  clear(): void {
    for (const chart of this.charts) chart.destroy();
    this.charts = [];
    this.node.replaceChildren();
  }

  private card(
    host: HTMLElement,
    name: string,
    { meaning, worse }: ParameterEntry,
    drives: readonly DriveEntry[],
    findings: readonly FindingEntry[],
  ): void {
    const having = drives.filter(({ estimates }) => Object.hasOwn(estimates, name)).reverse();
    const newest = having.at(-1)!.estimates[name]!;
    const changed = findings.find(
      ({ subject, start_us }) => subject.startsWith(name) && start_us === having.at(-1)!.from_us,
    );
    const about = { "aria-label": meaning, "data-parameter": name, "data-severity": changed?.severity ?? "" };
    const node = el(
      "section",
      { class: "panel parameter", ...about },
      el("h4", {}, capital(meaning)),
      el("p", { class: "num" }, words(newest)),
    );
    host.append(node);
    if (having.length < 2) {
      const note = el("p", { class: "note" }, "one drive so far");
      node.append(intervalBar(newest, changed?.baseline ?? null), note);
      return;
    }
    const [factor, unit] = scale(newest.unit, newest.value);
    const column = (end: "value" | "low" | "high"): number[] =>
      having.map(({ estimates }) => estimates[name]![end] * factor);
    const times = having.map(({ from_us }) => from_us / 1e6);
    const plot = el("div", { class: "plot" });
    const bad = { either: "", up: "; higher is worse", down: "; lower is worse" }[worse];
    node.append(plot, el("p", { class: "note" }, `${having.length} drives; band = 90 % interval${bad}`));
    const [first, last] = [times[0]!, times.at(-1)!];
    const around = Math.max((last - first) * MARGIN, 60);
    const places = digits(newest.low * factor, newest.high * factor);
    const write = (value: number): string => `${number(value, places)} ${unit}`;
    const curves = [{ label: meaning, colour: "--accent", points: true }];
    this.charts.push(
      new RangeChart(
        plot,
        { about: { title: meaning, write }, curves, hole_s: 3650 * DAY_S, band: true },
        [times, column("value"), column("low"), column("high")],
        [first - around, last + around],
      ),
    );
  }
}

function missing(lacking: readonly (readonly [string, string])[]): HTMLElement {
  const rows = lacking.map(([meaning, reason]) => el("li", {}, el("b", {}, capital(meaning)), `: ${reason}`));
  return el(
    "details",
    { class: "panel lacking" },
    el("summary", {}, `${lacking.length} not known of the newest drive`),
    el("ul", { class: "cases" }, ...rows),
  );
}
