// Adds a run of any robot to a comparison, or one of its laps.

import type { LapsAnswer, RunsAnswer } from "../base/contract";
import { NAME } from "../base/contract";
import { byName, el, Text } from "../base/dom";
import { age, number, when } from "../base/format";
import type { Part } from "../base/route";
import type { Fleet } from "../live/fleet";
import { AnswerError, ask } from "../server/answers";

const RUNS = 20;

export class AddPart {
  readonly node = el("form", { class: "range" });
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
  private looking: AbortController | undefined;
  private stream = "";

  constructor(
    private readonly fleet: Fleet,
    add: (part: Part) => void,
  ) {
    const button = el("button", { type: "submit", class: "tool" }, "Add");
    this.node.append(
      el("label", {}, "robot ", this.robot, this.known),
      el("label", {}, "run ", this.run),
      el("label", {}, "lap ", this.lap),
      button,
      this.note.node,
    );
    this.robot.addEventListener("change", () => void this.find());
    this.run.addEventListener("change", () => void this.findLaps());
    this.node.addEventListener("submit", (event) => {
      event.preventDefault();
      const part = this.laps[this.lap.selectedIndex - 1] ?? this.runs[this.run.selectedIndex];
      if (part) add(part);
    });
  }

  /** Offer the runs of a stream. */
  show(stream: string, robots: readonly string[]): void {
    const names = [...new Set([...robots, ...this.fleet.robots.keys()])].sort(byName);
    this.known.replaceChildren(...names.map((name) => el("option", { value: name })));
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
      const parts = runs
        .filter((run) => Object.hasOwn(run.streams, stream))
        .map((run) => run.streams[stream]!);
      this.runs = parts.map(({ from_us, to_us }) => ({
        robot,
        range: [Math.floor(from_us / 1000) / 1000, Math.ceil(to_us / 1000) / 1000],
      }));
      this.run.replaceChildren(
        ...this.runs.map(({ range: [from, to] }) => el("option", {}, `${when(from)}, ${age(to - from)}`)),
      );
      if (parts.length === 0) this.note.set(`${robot} has no runs of ${stream}.`);
      await this.findLaps();
    } catch (error) {
      if (robot !== this.robot.value.trim()) return;
      this.run.replaceChildren();
      this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }

  /** Offer the laps of the chosen run, if it has any. */
  private async findLaps(): Promise<void> {
    this.looking?.abort();
    const looking = (this.looking = new AbortController());
    const run = this.runs[this.run.selectedIndex];
    this.offer([]);
    if (!run) return;
    const [from_us, to_us] = run.range.map((at) => String(Math.round(at * 1e6))) as [string, string];
    try {
      this.offer(
        (await ask<LapsAnswer>("laps", { robot: run.robot, from_us, to_us }, looking.signal)).laps,
        run.robot,
      );
    } catch {
      // The whole run can be added anyway.
    }
  }

  private offer(laps: LapsAnswer["laps"], robot = ""): void {
    this.laps = laps.map(({ from_us, to_us }) => ({ robot, range: [from_us / 1e6, to_us / 1e6] }));
    const told = laps.map(
      ({ lap, time_s, best }) => `${lap}: ${number(time_s, 2)} s${best ? ", the best" : ""}`,
    );
    this.lap.replaceChildren(...["the whole run", ...told].map((text) => el("option", {}, text)));
  }
}
