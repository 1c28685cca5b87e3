// What the analysis says of a car's drives, or of the fleet's.

import type { Extent, InsightsAnswer, RunsAnswer } from "../base/contract";
import { el, Text, unserved } from "../base/dom";
import { when } from "../base/format";
import { type Range, readTime, writeTime } from "../base/range";
import { type Query, type RouteTo, route, setAddress } from "../base/route";
import { Analyse } from "../insights/analyse";
import { drivesTable } from "../insights/drives_table";
import { findingsList } from "../insights/findings_list";
import { LapsPanel } from "../insights/laps_panel";
import { Parameters } from "../insights/parameters";
import { may } from "../server/admission";
import { ask, Latest } from "../server/answers";
import { NotesPanel } from "../widgets/notes_panel";
import { type Services, type View, viewNode } from "./view";

const UNSERVED =
  "This page was put on the web as it is, and cannot read the findings. Run `iort dashboard`, or `iort findings`.";

export class InsightsView implements View<RouteTo<"insights">> {
  readonly node: HTMLElement;
  private readonly name = new Text("car-name", "h2");
  private readonly tools = el("p", { class: "tools" });
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly found = el("div", { class: "insights-part" });
  private readonly driven = el("div", { class: "insights-part" });
  private readonly parameters = new Parameters();
  private readonly notes: NotesPanel;
  private readonly laps = new LapsPanel((laps) => this.write(laps));
  private readonly analyse = new Analyse(
    (text) => this.note.set(text),
    (drives) => void this.analysed(drives),
  );
  private readonly loading = new Latest();
  private robot: string | undefined;
  private answer: InsightsAnswer | undefined;
  private drive: Range | undefined;

  constructor(private readonly services: Services) {
    const { config } = services;
    this.notes = new NotesPanel(config);
    const status = el(
      "div",
      { class: "history-status" },
      this.note.node,
      ...(may(config, "analyse") ? [this.analyse.node] : []),
    );
    const served = [status, this.found, this.notes.node, this.laps.node, this.parameters.node, this.driven];
    this.node = viewNode(
      "insights-view",
      this.name.node,
      [el("p", { class: "car-state" }, "insights"), this.tools],
      ...(config.answers ? served : [unserved(UNSERVED)]),
    );
  }

  title({ robot }: RouteTo<"insights">): string {
    return `${robot ?? "Insights"} · iort`;
  }

  show({ robot, query = {} }: RouteTo<"insights">): void {
    this.name.set(robot ?? "Fleet");
    this.tools.replaceChildren(
      ...(robot === undefined
        ? []
        : [
            el("a", { class: "tool", href: route({ view: "car", robot }) }, "Live"),
            el("a", { class: "tool", href: route({ view: "history", robot }) }, "History"),
            el("a", { class: "tool", href: route({ view: "insights" }) }, "Fleet"),
          ]),
    );
    if (!this.services.config.answers) return;
    this.analyse.of(robot);
    void this.notes.show(robot);
    if (robot !== this.robot || !this.answer) void this.load(robot, query);
    else
      void this.loading.run(
        (signal) => this.present(query, signal),
        (reason) => this.note.set(reason),
      );
  }

  leave(): void {
    this.loading.stop();
    this.analyse.stop();
    this.answer = undefined;
    this.laps.clear();
    this.parameters.clear();
  }

  private async load(robot: string | undefined, query: Query<"insights">): Promise<void> {
    this.robot = robot;
    this.answer = undefined;
    for (const part of [this.found, this.driven]) part.replaceChildren();
    this.parameters.clear();
    this.laps.clear();
    this.laps.node.hidden = true;
    this.note.set("Loading …");
    await this.loading.run(
      async (signal) => {
        const asked = robot === undefined ? {} : { robot };
        this.answer = await ask<InsightsAnswer>("insights", asked, signal);
        await this.present(query, signal);
      },
      (reason) => {
        this.note.set(reason);
        // Laps need no findings.
        if (robot !== undefined && !this.answer) void this.lapsAlone(robot, query);
      },
    );
  }

  private async lapsAlone(robot: string, query: Query<"insights">): Promise<void> {
    await this.loading.run(
      (signal) => this.showLaps(robot, undefined, query, signal),
      () => undefined,
    );
  }

  /** Show the new findings; without drives, say why there are none. */
  private async analysed(drives: number): Promise<void> {
    await this.load(this.robot, {});
    if (drives === 0)
      this.note.set("No drives were found in that time: nothing was recorded, or the car stood.");
  }

  private async present(query: Query<"insights">, signal: AbortSignal): Promise<void> {
    const { robot } = this;
    const answer = this.answer!;
    const { findings, drives } = answer;
    const newest = drives[0];
    const of = robot ?? "the fleet";
    const state = newest
      ? `The newest analysed drive began ${when(newest.from_us / 1e6)}.`
      : `No drive of ${of} has been analysed yet: that happens every night, or now by iort analyse${robot === undefined ? " --fleet" : ` ${robot}`}.`;
    this.note.set(state);
    const list = findingsList(findings, robot === undefined);
    const nothing = unserved(
      newest
        ? `Nothing about ${of} differs from its earlier drives by more than chance.`
        : "There are no findings without analysed drives.",
    );
    this.found.replaceChildren(list.childElementCount > 0 ? list : nothing);
    const wanted = readTime(query.drive);
    const chosen =
      drives.find(({ from_us }) => Math.abs(from_us / 1e6 - wanted) < 0.01) ??
      drives.find(({ failed }) => failed === "");
    this.driven.replaceChildren(...(newest ? [drivesTable(drives, robot, chosen?.from_us)] : []));
    if (robot === undefined) return;
    this.parameters.show(answer);
    await this.showLaps(robot, chosen, query, signal);
  }

  /** Show the laps of a drive; before anything is analysed, those of the newest run. */
  private async showLaps(
    robot: string,
    of: Extent | undefined,
    query: Query<"insights">,
    signal: AbortSignal,
  ): Promise<void> {
    const extent = of ?? (await ask<RunsAnswer>("runs", { robot, count: "1" }, signal)).runs[0];
    this.laps.node.hidden = extent === undefined;
    if (!extent) return;
    this.drive = [extent.from_us / 1e6, extent.to_us / 1e6];
    const wanted = (query.laps ?? "").split(",").map(Number);
    await this.laps.show(
      robot,
      this.drive,
      wanted.filter((lap) => lap > 0),
    );
  }

  private write(laps: readonly number[]): void {
    const { robot, drive } = this;
    if (robot !== undefined && drive)
      setAddress({ view: "insights", robot, query: { drive: writeTime(drive[0]), laps: laps.join(",") } });
  }
}
