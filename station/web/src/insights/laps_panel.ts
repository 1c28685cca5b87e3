// The laps of a drive: a table with the best one, and two of them against distance.

import type { DeltaAnswer, Lap, LapsAnswer } from "../base/contract";
import { el, panel, Text, table } from "../base/dom";
import { capital, number, when } from "../base/format";
import { inUs, type Range, same } from "../base/range";
import { MOST_PARTS, offerComparison } from "../base/route";
import { type Columns, LinesPanel } from "../charts/lines_panel";
import { ask, Latest } from "../server/answers";
import { words } from "./figures";

const METHODS: Readonly<Record<string, string>> = {
  gate: "Laps by crossing a gate of the position",
  pattern: "Laps by the pattern of the drive, because no stream has a position",
};
const FIGURES = { lap_best_s: "best", lap_mean_s: "mean", lap_energy_wh_per_km: "energy" };
const HEAD = ["Compare", "Lap", "Start", "Time", "Behind", "Distance", "Energy", "per km", "Mean"];
const SYNC = "laps";

export class LapsPanel {
  readonly node: HTMLElement;
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly body = el("tbody");
  private readonly table = el("div", { class: "laps-table", hidden: "" });
  private readonly compare = el("a", { class: "tool" });
  private readonly charts = el("div", { class: "charts" });
  private drawn: LinesPanel[] = [];
  private readonly loading = new Latest();
  private chosen: number[] = [];
  private laps: readonly Lap[] = [];
  private robot = "";
  private range: Range = [0, 1];

  /** `changed` is called with the chosen laps. */
  constructor(private readonly changed: (laps: readonly number[]) => void) {
    this.table.append(table(HEAD, this.body));
    this.node = panel("Laps", "laps", [this.compare], this.note.node, this.table, this.charts);
  }

  /** Show the laps of a robot in a range; `wanted` are those to compare, or else the best two. */
  async show(robot: string, range: Range, wanted: readonly number[]): Promise<void> {
    if (robot === this.robot && same(range, this.range) && this.laps.length > 0) return;
    this.clear();
    [this.robot, this.range] = [robot, range];
    this.note.set("Looking for laps …");
    await this.loading.run(
      async (signal) => this.list(await ask<LapsAnswer>("laps", this.asked(), signal), wanted),
      (reason) => this.note.set(reason),
    );
  }

  clear(): void {
    this.loading.stop();
    this.undraw();
    this.laps = [];
    this.table.hidden = true;
    this.compare.hidden = true;
    this.note.set("");
  }

  private asked(): Record<string, string> {
    return { robot: this.robot, ...inUs(this.range) };
  }

  private list(answer: LapsAnswer, wanted: readonly number[]): void {
    this.laps = answer.laps;
    this.note.set(about(answer));
    this.table.hidden = answer.laps.length === 0;
    const known = wanted.filter((lap) => lap <= answer.laps.length).slice(0, MOST_PARTS);
    const fastest = answer.laps.filter(({ complete }) => complete).sort((a, b) => a.time_s - b.time_s);
    this.chosen = known.length > 0 ? known : fastest.slice(0, 2).map(({ lap }) => lap);
    this.body.replaceChildren(...answer.laps.map((lap) => this.row(lap, fastest[0]?.time_s ?? 0)));
    this.choose();
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
    this.compare.hidden = this.laps.length === 0;
    offerComparison(this.compare, parts, "laps", `All fields of ${parts.length} laps`, { x: "distance" });
    void this.draw();
  }

  /** Draw the first two chosen laps against distance. */
  private async draw(): Promise<void> {
    const [one, other] = this.chosen;
    this.undraw();
    if (one === undefined || other === undefined) return;
    const asked = { ...this.asked(), one: String(one), other: String(other) };
    await this.loading.run(
      async (signal) => {
        const delta = await ask<DeltaAnswer>("delta", asked, signal);
        this.undraw();
        this.chart(`Lap ${other} behind lap ${one}`, "s", 3, ["Delta"], [delta.delta_s], delta);
        if (delta.one_mps.some((speed) => speed !== null)) {
          const names = [`Lap ${one}`, `Lap ${other}`];
          this.chart("Speed", "m/s", 2, names, [delta.one_mps, delta.other_mps], delta);
        }
      },
      (reason) => this.note.set(reason),
    );
  }

  private chart(
    title: string,
    unit: string,
    digits: number,
    names: readonly string[],
    columns: Columns,
    { places, unit: along }: DeltaAnswer,
  ): void {
    const read = (index: number | null): void => drawn.read(index ?? places.length - 1);
    const drawn = new LinesPanel({ title, sync: SYNC, zero: names.length === 1, onCursor: read });
    const lines = names.map((label) => ({ label, unit, digits }));
    drawn.draw({ x: places, along, hole: Infinity, columns, lines }, [0, places.at(-1) ?? 1]);
    read(null);
    this.charts.append(drawn.node);
    this.drawn.push(drawn);
  }

  private undraw(): void {
    for (const chart of this.drawn) chart.destroy();
    this.drawn = [];
  }
}

function about({ laps, method, confidence, reason, estimates }: LapsAnswer): string {
  if (laps.length === 0) return `${capital(reason)}.`;
  const figures = Object.entries(FIGURES).flatMap(([name, word]) =>
    estimates[name] ? [`${word} ${words(estimates[name])}`] : [],
  );
  return `${METHODS[method] ?? method}, ${number(confidence * 100, 0)} % sure: ${figures.join(", ")}.`;
}
