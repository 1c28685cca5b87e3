// Adds another robot's run to a comparison.

import type { RunsAnswer } from "../base/contract";
import { byName, el, Text } from "../base/dom";
import { age, dayTime, zone } from "../base/format";
import { NAME } from "../base/contract";
import type { Part } from "../base/route";
import type { Fleet } from "../live/fleet";
import { ask, AnswerError } from "../server/answers";

const RUNS = 20;

export class AddPart {
  readonly node = el("form", { class: "range" });
  private readonly robot = el("input", { id: "part-robot", list: "part-robots", autocomplete: "off", spellcheck: "false" });
  private readonly known = el("datalist", { id: "part-robots" });
  private readonly run = el("select", { id: "part-run" });
  private readonly note = new Text("note", "span", { role: "status" });
  private runs: Part[] = [];
  private stream = "";

  constructor(
    private readonly fleet: Fleet,
    add: (part: Part) => void,
  ) {
    const button = el("button", { type: "submit", class: "tool" }, "Add");
    this.node.append(el("label", {}, "robot ", this.robot, this.known), el("label", {}, "run ", this.run), button, this.note.node);
    this.robot.addEventListener("change", () => void this.find());
    this.node.addEventListener("submit", (event) => {
      event.preventDefault();
      const part = this.runs[this.run.selectedIndex];
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
    this.note.set("");
    if (!NAME.test(robot)) return;
    try {
      const { runs } = await ask<RunsAnswer>("runs", { robot, count: String(RUNS) });
      if (robot !== this.robot.value.trim() || stream !== this.stream) return;
      const parts = runs.filter((run) => Object.hasOwn(run.streams, stream)).map((run) => run.streams[stream]!);
      this.runs = parts.map(({ from_us, to_us }) => ({ robot, range: [Math.floor(from_us / 1000) / 1000, Math.ceil(to_us / 1000) / 1000] }));
      this.run.replaceChildren(...this.runs.map(({ range: [from, to] }) => el("option", {}, `${dayTime(from)} ${zone(from)}, ${age(to - from)}`)));
      if (parts.length === 0) this.note.set(`${robot} has no runs of ${stream}.`);
    } catch (error) {
      if (robot === this.robot.value.trim()) this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }
}
