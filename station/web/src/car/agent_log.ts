// The warnings and errors of a car's agent: those that come live, and those of the last hour from the page's server.

import { type Config, type HistoryAnswer, LOG_STREAM } from "../base/contract";
import { el, panel, Text } from "../base/dom";
import { when } from "../base/format";
import { inUs } from "../base/range";
import { type Line, lineOf } from "../live/lines";
import type { Robot } from "../live/robot";
import { ask, Latest } from "../server/answers";

const BACK_S = 3600;
// More than an agent sends in an hour: a row of several lines would have the last one alone.
const ROWS = 3000;
const SHOWN = 100;

export class AgentLog {
  private readonly note = new Text("note", "p");
  private readonly list = el("ol", { class: "lines" });
  readonly node = panel("Agent's log", "agent-log", [this.note.node], this.list);
  private readonly finding = new Latest();
  private past: readonly Line[] = [];
  private robot: string | undefined;
  private drawn = "";

  constructor(private readonly config: Config) {}

  /** Show this car's lines from now on. */
  of(robot: string): void {
    if (robot === this.robot) return;
    [this.robot, this.past, this.drawn] = [robot, [], ""];
    if (this.config.answers) void this.find(robot);
  }

  refresh(robot: Robot): void {
    const key = `${this.past.length} ${robot.lines.length} ${robot.lines.at(-1)?.t_us ?? 0}`;
    if (key === this.drawn) return;
    this.drawn = key;
    const first = robot.lines[0]?.t_us ?? Infinity;
    const lines = [...this.past.filter(({ t_us }) => t_us < first), ...robot.lines].slice(-SHOWN).reverse();
    this.note.set(
      lines.length > 0
        ? "warnings and errors"
        : this.config.answers
          ? "no warnings in the last hour"
          : "no warnings since this page was opened",
    );
    this.list.replaceChildren(...lines.map(row));
  }

  private async find(robot: string): Promise<void> {
    // Not a microsecond over an hour: longer ranges are answered from the summaries, which have no texts.
    const now = Date.now() / 1000;
    const asked = { robot, stream: LOG_STREAM, ...inUs([now - BACK_S, now]), rows: String(ROWS) };
    await this.finding.run(
      async (signal) => {
        const { times_s, fields } = await ask<HistoryAnswer>("history", asked, signal);
        this.past = times_s.flatMap(
          (at, i) => lineOf(Math.round(at * 1e6), (name) => fields[name]?.mean[i]) ?? [],
        );
      },
      // What comes live is shown all the same; a car that never warned has no such stream.
      () => undefined,
    );
  }
}

function row({ t_us, level, logger, text, leftOut }: Line): HTMLElement {
  const left =
    leftOut > 0 ? [" ", el("span", { class: "note" }, `${leftOut} lines before were left out`)] : [];
  return el(
    "li",
    { "data-level": level, title: logger },
    el("span", { class: "line-head" }, el("b", {}, level), " ", when(t_us / 1e6)),
    text,
    ...left,
  );
}
