// Adds a run of any robot to a comparison, or one of its laps.

import { type LapsAnswer, NAME, type RunsAnswer } from "../base/contract";
import { byName, choices, el, form, Text } from "../base/dom";
import { age, when } from "../base/format";
import { inUs, rangeOf } from "../base/range";
import type { Part } from "../base/route";
import type { Fleet } from "../live/fleet";
import { ask, Latest, words } from "../server/answers";
import { lapLabel } from "./laps_list";

const RUNS = 20;

export class AddPart {
  readonly node: HTMLElement;
  private readonly robot = el("input", {
    id: "part-robot",
    list: "part-robots",
    autocomplete: "off",
    spellcheck: "false",
  });
  private readonly known = el("datalist", { id: "part-robots" });
  private readonly run = el("select", { id: "part-run" });
  private readonly lap = el("select", { id: "part-lap" });
  private readonly note = new Text("note", "span", { role: "status" });
  private runs: Part[] = [];
  private laps: Part[] = [];
  private readonly looking = new Latest();
  private stream = "";

  constructor(
    private readonly fleet: Fleet,
    add: (part: Part) => void,
  ) {
    this.node = form(
      { class: "range" },
      () => {
        const part = this.laps[this.lap.selectedIndex - 1] ?? this.runs[this.run.selectedIndex];
        if (part) add(part);
      },
      el("label", {}, "robot ", this.robot, this.known),
      el("label", {}, "run ", this.run),
      el("label", {}, "lap ", this.lap),
      el("button", { type: "submit", class: "tool" }, "Add"),
      this.note.node,
    );
    this.robot.addEventListener("change", () => void this.find());
    this.run.addEventListener("change", () => void this.findLaps());
  }

  /** Offer the runs of a stream. */
  show(stream: string, robots: readonly string[]): void {
    const names = [...new Set([...robots, ...this.fleet.robots.keys()])].sort(byName);
    this.known.replaceChildren(...choices(names));
    if (stream === this.stream && this.runs.length > 0) return;
    this.stream = stream;
    this.robot.value ||= robots[0] ?? "";
    void this.find();
  }

  private async find(): Promise<void> {
    const robot = this.robot.value.trim();
    const { stream } = this;
    this.runs = [];
    this.run.replaceChildren();
    this.offer([]);
    this.note.set("");
    if (!NAME.test(robot)) return;
    this.run.replaceChildren(el("option", {}, "Loading …"));
    try {
      const { runs } = await ask<RunsAnswer>("runs", { robot, count: String(RUNS) });
      if (robot !== this.robot.value.trim() || stream !== this.stream) return;
      const of = runs.filter((run) => Object.hasOwn(run.streams, stream));
      this.runs = of.map(({ streams }) => ({ robot, range: rangeOf(streams[stream]!) }));
      this.run.replaceChildren(
        ...this.runs.map(({ range: [from, to] }) => el("option", {}, `${when(from)}, ${age(to - from)}`)),
      );
      if (of.length === 0) this.note.set(`${robot} has no runs of ${stream}.`);
      await this.findLaps();
    } catch (error) {
      if (robot !== this.robot.value.trim()) return;
      this.run.replaceChildren();
      this.note.set(words(error));
    }
  }

  /** Offer the laps of the chosen run, if it has any. */
  private async findLaps(): Promise<void> {
    this.looking.stop();
    const run = this.runs[this.run.selectedIndex];
    this.offer([]);
    if (!run) return;
    await this.looking.run(
      async (signal) => {
        const asked = { robot: run.robot, ...inUs(run.range) };
        this.offer((await ask<LapsAnswer>("laps", asked, signal)).laps, run.robot);
      },
      // The whole run can be added anyway.
      () => undefined,
    );
  }

  private offer(laps: LapsAnswer["laps"], robot = ""): void {
    this.laps = laps.map(({ from_us, to_us }) => ({ robot, range: [from_us / 1e6, to_us / 1e6] }));
    this.lap.replaceChildren(...choices(["the whole run", ...laps.map(lapLabel)]));
  }
}
