// Fills the charts of a watched car with what was recorded before this page heard it, from the page's server.

import { now } from "../base/clock";
import { type Config, type HistoryAnswer, LOG_STREAM } from "../base/contract";
import { AnswerError, ask } from "../server/answers";
import type { Robot } from "./robot";
import type { Stream } from "./stream";

const LEAST_S = 300;
// About a row for each live sample of the last five minutes.
const ROWS = 3000;
// The newest second was not recorded yet when the page asked first.
const RECORDED_S = 4;
// Values further apart are not those of a car that is looked at closely.
const HOLE_S = 0.9;

export class Past {
  private robot: Robot | undefined;
  private stopped = new AbortController();
  /** For each stream the oldest time that was asked for, on the page's clock. */
  private asked = new Map<Stream, number>();
  private queue: Promise<void> = Promise.resolve();

  constructor(private readonly config: Config) {}

  /** Ask for what is missing of the last `back_s` seconds, five minutes at least; for another car, from the beginning. */
  fill(robot: Robot | undefined, back_s: number): void {
    if (robot !== this.robot) {
      this.stopped.abort();
      [this.robot, this.stopped, this.asked] = [robot, new AbortController(), new Map()];
    }
    if (!robot || !this.config.answers) return;
    const from = now() - Math.max(LEAST_S, back_s);
    for (const stream of robot.streams.values()) {
      // Its lines are texts: car/agent_log.ts.
      if (stream.name === LOG_STREAM) continue;
      const heard = heardSince(stream);
      const to = this.asked.get(stream) ?? heard;
      if (!(from < to - 1)) continue;
      const first = !this.asked.has(stream);
      this.asked.set(stream, from);
      this.ask(robot, stream, from, to);
      if (first)
        window.setTimeout(() => this.robot === robot && this.join(robot, stream, heard), RECORDED_S * 1000);
    }
  }

  /** Ask for what was not recorded when the page asked first, up to what it hears since the car is awake. */
  private join(robot: Robot, stream: Stream, heard: number): void {
    const awake = Math.max(heard, heardSince(stream));
    this.ask(robot, stream, heard - RECORDED_S, awake);
  }

  /** Add what was recorded in a range, one question after the other. */
  private ask(robot: Robot, stream: Stream, from: number, to: number): void {
    const { signal } = this.stopped;
    // From the car's clock to the page's.
    const shift = stream.takenAt - stream.t_us / 1e6;
    const us = (at: number): string => String(Math.round((at - shift) * 1e6));
    const asked = {
      robot: robot.name,
      stream: stream.name,
      from_us: us(from),
      to_us: us(to),
      rows: String(ROWS),
    };
    this.queue = this.queue.then(async () => {
      if (signal.aborted) return;
      try {
        const answer = await ask<HistoryAnswer>("history", asked, signal);
        if (!signal.aborted) add(stream, answer, shift, to);
      } catch (error) {
        // Without a past, the charts begin with what was heard, as on a static site.
        if (!signal.aborted && !(error instanceof AnswerError)) throw error;
      }
    });
  }
}

/** Since when a stream has been heard without a hole: an idle car's values, or those of a card, are far apart. */
function heardSince({ history }: Stream): number {
  const times = history.column(0);
  let at = times.length - 1;
  while (at > 0 && times[at]! - times[at - 1]! <= HOLE_S) at -= 1;
  return times[at] ?? NaN;
}

function add(stream: Stream, answer: HistoryAnswer, shift: number, before: number): void {
  const rows = [...answer.times_s.keys()].filter((row) => answer.times_s[row]! + shift < before);
  const fields = new Map<string, Float64Array>();
  for (const [field, { mean }] of Object.entries(answer.fields)) {
    const values = rows.map((row) => mean[row]);
    if (!values.some((value) => typeof value === "number")) continue;
    fields.set(
      field,
      Float64Array.from(values, (value) => (typeof value === "number" ? value : NaN)),
    );
  }
  stream.prefill(
    rows.map((row) => answer.times_s[row]! + shift),
    fields,
  );
}
