// The laps of a drive: a table with the best one, and two of them against distance.

import type { DeltaAnswer, Lap, LapsAnswer } from "../base/contract";
import { el, Text } from "../base/dom";
import { number, when } from "../base/format";
import type { Range } from "../base/range";
import { MOST_PARTS, route, writeParts } from "../base/route";
import { type Curve, RangeChart } from "../charts/range_chart";
import { dash, hue } from "../history/compare_charts";
import { AnswerError, ask } from "../server/answers";
import { words } from "./figures";

const METHODS: Readonly<Record<string, string>> = {
  gate: "Laps by crossing a gate of the position",
  pattern: "Laps by the pattern of the drive, because no stream has a position",
};
const HEAD = ["Compare", "Lap", "Start", "Time", "Behind", "Distance", "Energy", "per km", "Mean"];
const SYNC = "laps";

export class LapsPanel {
  readonly node: HTMLElement;
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly body = el("tbody");
  private readonly table = el("div", { class: "laps-table", hidden: "" });
  private readonly compare = el("a", { class: "tool" });
  private readonly charts = el("div", { class: "charts" });
  private drawn: RangeChart[] = [];
  private loading: AbortController | undefined;
  private chosen: number[] = [];
  private laps: readonly Lap[] = [];
  private robot = "";
  private range: Range = [0, 1];

  /** `changed` is called with the chosen laps. */
  constructor(private readonly changed: (laps: readonly number[]) => void) {
    this.table.append(
      el(
        "table",
        {},
        el("thead", {}, el("tr", {}, ...HEAD.map((text) => el("th", { scope: "col" }, text)))),
        this.body,
      ),
    );
    this.node = el(
      "section",
      { class: "panel laps", "aria-label": "Laps" },
      el("header", {}, el("h3", {}, "Laps"), this.compare),
      this.note.node,
      this.table,
      this.charts,
    );
  }

  /** Show the laps of a robot in a range; `wanted` are those to compare, or else the best two. */
  async show(robot: string, range: Range, wanted: readonly number[]): Promise<void> {
    if (
      robot === this.robot &&
      range[0] === this.range[0] &&
      range[1] === this.range[1] &&
      this.laps.length > 0
    )
      return;
    this.clear();
    [this.robot, this.range] = [robot, range];
    const loading = (this.loading = new AbortController());
    this.note.set("Looking for laps …");
    try {
      const answer = await ask<LapsAnswer>("laps", this.asked(), loading.signal);
      if (loading.signal.aborted) return;
      this.laps = answer.laps;
      this.note.set(about(answer));
      this.table.hidden = answer.laps.length === 0;
      const known = wanted.filter((lap) => lap <= answer.laps.length).slice(0, MOST_PARTS);
      const fastest = answer.laps.filter(({ complete }) => complete).sort((a, b) => a.time_s - b.time_s);
      this.chosen = known.length > 0 ? known : fastest.slice(0, 2).map(({ lap }) => lap);
      const least = fastest[0]?.time_s ?? 0;
      this.body.replaceChildren(...answer.laps.map((lap) => this.row(lap, least)));
      this.choose();
    } catch (error) {
      if (!loading.signal.aborted)
        this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }

  clear(): void {
    this.loading?.abort();
    this.undraw();
    this.laps = [];
    this.table.hidden = true;
    this.compare.hidden = true;
    this.note.set("");
  }

  private asked(): Record<string, string> {
    const [from_us, to_us] = this.range.map((at) => String(Math.round(at * 1e6))) as [string, string];
    return { robot: this.robot, from_us, to_us };
  }

  private row(lap: Lap, least: number): HTMLElement {
    const check = el("input", { type: "checkbox", "aria-label": `Compare lap ${lap.lap}` });
    check.checked = this.chosen.includes(lap.lap);
    check.addEventListener("change", () => {
      this.chosen = check.checked
        ? [...this.chosen, lap.lap]
        : this.chosen.filter((each) => each !== lap.lap);
      this.changed(this.chosen);
      this.choose();
    });
    const known = (value: number | null, digits: number, unit: string): string =>
      value === null ? "" : `${number(value, digits)} ${unit}`;
    const behind = lap.best ? "best" : lap.complete ? `+${number(lap.time_s - least, 3)} s` : "not complete";
    const cells = [
      when(lap.from_us / 1e6),
      `${number(lap.time_s, 3)} s`,
      behind,
      known(lap.distance_m, 1, "m"),
      known(lap.energy_wh, 3, "Wh"),
      known(lap.energy_wh_per_km, 2, "Wh"),
      known(lap.mean_speed_mps, 2, "m/s"),
    ];
    return el(
      "tr",
      { "data-lap": String(lap.lap), "data-best": String(lap.best), "data-complete": String(lap.complete) },
      el("td", {}, el("label", {}, check)),
      el("th", { scope: "row" }, String(lap.lap)),
      ...cells.map((text) => el("td", {}, text)),
    );
  }

  private choose(): void {
    const { chosen, robot } = this;
    const parts = chosen
      .flatMap((each) => this.laps.filter(({ lap }) => lap === each))
      .map(({ from_us, to_us }) => ({ robot, range: [from_us / 1e6, to_us / 1e6] as const }));
    const few =
      parts.length < 2
        ? "Check two laps to compare them"
        : parts.length > MOST_PARTS
          ? `At most ${MOST_PARTS} laps can be compared`
          : "";
    this.compare.hidden = this.laps.length === 0;
    this.compare.textContent = few || `All fields of ${parts.length} laps`;
    if (few) this.compare.removeAttribute("href");
    else this.compare.href = route({ view: "compare", query: { runs: writeParts(parts), x: "distance" } });
    void this.draw();
  }

  /** Draw the first two chosen laps against distance. */
  private async draw(): Promise<void> {
    const [one, other] = this.chosen;
    this.undraw();
    if (one === undefined || other === undefined) return;
    const loading = (this.loading = new AbortController());
    try {
      const delta = await ask<DeltaAnswer>(
        "delta",
        { ...this.asked(), one: String(one), other: String(other) },
        loading.signal,
      );
      if (loading.signal.aborted) return;
      this.undraw();
      this.chart(
        `Lap ${other} behind lap ${one}`,
        "s",
        3,
        [{ label: "Delta", colour: "--accent" }],
        [delta.delta_s],
        delta,
        true,
      );
      const curves = [one, other].map((lap, i) => ({
        label: `Lap ${lap}`,
        colour: `--${hue(i)}`,
        dash: dash(i),
      }));
      if (delta.one_mps.some((speed) => speed !== null))
        this.chart("Speed", "m/s", 2, curves, [delta.one_mps, delta.other_mps], delta, false);
    } catch (error) {
      if (!loading.signal.aborted)
        this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }

  private chart(
    title: string,
    unit: string,
    digits: number,
    curves: readonly Curve[],
    columns: readonly (readonly (number | null)[])[],
    { places, unit: of }: DeltaAnswer,
    zero: boolean,
  ): void {
    const readings = columns.map(() => new Text("num"));
    const plot = el("div", { class: "plot" });
    const values = readings.map(({ node }, i) =>
      el(
        "p",
        { class: "reading" },
        ...(curves.length > 1
          ? [el("span", { class: `key ${hue(i)}` }), el("span", { class: "label" }, curves[i]!.label)]
          : []),
        node,
        el("span", { class: "unit" }, unit),
      ),
    );
    this.charts.append(
      el(
        "section",
        { class: "panel", "aria-label": title },
        el("header", {}, el("h3", {}, title), ...values),
        plot,
      ),
    );
    const read = (index: number | null): void =>
      readings.forEach((text, i) => text.set(number(columns[i]![index ?? places.length - 1] ?? NaN, digits)));
    read(null);
    const about = { title, write: (value: number) => `${number(value, digits)} ${unit}` };
    const data = [[...places], ...columns.map((column) => [...column])] as [number[], ...(number | null)[][]];
    this.drawn.push(
      new RangeChart(
        plot,
        { about, curves, sync: SYNC, hole_s: Infinity, unit: of, zero, onCursor: read },
        data,
        [0, places.at(-1) ?? 1],
      ),
    );
  }

  private undraw(): void {
    for (const chart of this.drawn) chart.destroy();
    this.drawn = [];
    this.charts.replaceChildren();
  }
}

function about({ laps, method, confidence, reason, estimates }: LapsAnswer): string {
  if (laps.length === 0) return `${reason.charAt(0).toUpperCase()}${reason.slice(1)}.`;
  const told = (["lap_best_s", "lap_mean_s", "lap_energy_wh_per_km"] as const).flatMap((name) =>
    estimates[name]
      ? [
          `${{ lap_best_s: "best", lap_mean_s: "mean", lap_energy_wh_per_km: "energy" }[name]} ${words(estimates[name])}`,
        ]
      : [],
  );
  return `${METHODS[method] ?? method}, ${number(confidence * 100, 0)} % sure: ${told.join(", ")}.`;
}
