// A robot's runs: each opens its range, and several open side by side.

import type { Extent, Run, RunsAnswer } from "../base/contract";
import { button, el, table } from "../base/dom";
import { age, number, when } from "../base/format";
import { type Range, rangeOf, writeTime } from "../base/range";
import { offerComparison, route } from "../base/route";

export class RunsList {
  readonly node = el("details", { class: "panel runs" });
  private readonly about = el("summary", {}, "Runs");
  private readonly body = el("tbody");
  private readonly more = button("Older runs", () => this.older(this.runs.at(-1)!.from_us));
  private readonly compare = el("a", { class: "tool" }, "Compare");
  private readonly chosen = new Map<string, Range>();
  private robot = "";
  private stream = "";
  private runs: readonly Run[] = [];
  private extents: Readonly<Record<string, Extent>> = {};

  /** `older` is called for the runs before a time in microseconds. */
  constructor(private readonly older: (before_us: number) => void) {
    this.node.append(
      this.about,
      table(["Compare", "Start", "Length", "Samples", "State"], this.body),
      el("p", { class: "tools" }, this.more, this.compare),
    );
  }

  /** The newest run that has the stream, or else the newest: the runs do not tell of the agent's own streams. */
  newest(stream: string): Range | undefined {
    const run = this.runs.find(({ streams }) => Object.hasOwn(streams, stream));
    const part = run ? run.streams[stream] : this.runs[0];
    return part && rangeOf(part);
  }

  /** All that is stored of a stream, where known. */
  extent(stream: string): Range | undefined {
    return Object.hasOwn(this.extents, stream) ? rangeOf(this.extents[stream]!) : undefined;
  }

  set(robot: string, answer: RunsAnswer | undefined): void {
    if (robot !== this.robot) this.chosen.clear();
    this.robot = robot;
    this.runs = answer?.runs ?? [];
    this.extents = answer?.streams ?? {};
    this.more.hidden = answer?.older !== true;
    this.show(this.stream);
  }

  /** Say why the runs are not known. */
  fail(reason: string): void {
    this.node.hidden = false;
    this.about.textContent = `Runs: ${reason}`;
  }

  add(answer: RunsAnswer): void {
    this.runs = [...this.runs, ...answer.runs];
    this.more.hidden = !answer.older;
    this.show(this.stream);
  }

  /** List the runs that have a stream. */
  show(stream: string): void {
    if (stream !== this.stream) this.chosen.clear();
    this.stream = stream;
    const runs = this.runs.filter((run) => Object.hasOwn(run.streams, stream));
    const extent = this.extent(stream);
    this.node.hidden = runs.length === 0;
    this.about.textContent = `Runs${extent ? `: ${stream} is stored from ${when(extent[0])} to ${when(extent[1])}` : ""}`;
    this.body.replaceChildren(...runs.map((run) => this.row(run)));
    this.choose();
  }

  private row(run: Run): HTMLElement {
    const part = run.streams[this.stream]!;
    const [from, to] = rangeOf(part);
    const { robot, stream } = this;
    const check = el("input", { type: "checkbox", "aria-label": `Compare the run of ${when(from)}` });
    check.checked = this.chosen.has(run.run);
    check.addEventListener("change", () => {
      if (check.checked) this.chosen.set(run.run, [from, to]);
      else this.chosen.delete(run.run);
      this.choose();
    });
    const query = { stream, from: writeTime(from), to: writeTime(to) };
    const link = el("a", { href: route({ view: "history", robot, query }) }, when(from));
    const samples = part.samples === null ? "" : number(part.samples);
    const state = run.lost > 0 ? `${run.state}, ${number(run.lost)} lost` : run.state;
    return el(
      "tr",
      { "data-run": run.run },
      el("td", {}, el("label", {}, check)),
      el("th", { scope: "row" }, link),
      ...[age(to - from), samples, state].map((text) => el("td", {}, text)),
    );
  }

  private choose(): void {
    const parts = [...this.chosen.values()].map((range) => ({ robot: this.robot, range }));
    offerComparison(this.compare, parts, "runs", `Compare ${parts.length} runs`, { stream: this.stream });
  }
}
