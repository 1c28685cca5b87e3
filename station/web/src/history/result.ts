// What was stored in a range: its charts and pictures, with a cursor, a playback, and the live values beside it.

import type { FieldTable, HistoryAnswer } from "../base/contract";
import { el } from "../base/dom";
import { asSpeed, numbers, type Spec, spec } from "../base/format";
import type { Range } from "../base/range";
import type { Hands, Mark } from "../charts/range_chart";
import type { Fleet } from "../live/fleet";
import { Comparison } from "../widgets/comparison";
import { Download } from "./download";
import { type Charted, FieldCharts } from "./field_charts";
import { Pictures } from "./pictures";
import { Playback } from "./playback";

const USUAL = ["speed", "voltage_input", "current_motor", "current_input", "duty_cycle", "temperature_pcb"];
const MOST_CHARTS = 12;

export interface ResultOptions {
  readonly hands: Omit<Hands, "pick">;
  /** The parameters of a download. */
  readonly asked: () => Readonly<Record<string, string>>;
  /** The viewer has chosen other fields, or another time. */
  readonly changed: () => void;
}

export class Result {
  readonly node = el("div", { class: "result", hidden: "" });
  /** The fields that the viewer has chosen; empty for the usual ones. */
  wanted: readonly string[] = [];
  /** The time that the viewer points at; NaN for the end. */
  at = NaN;
  private readonly playback: Playback;
  private readonly charts: FieldCharts;
  private readonly pictures: Pictures;
  private readonly comparison = new Comparison();
  private drive: HistoryAnswer | undefined;
  private robot = "";
  private stream = "";
  private left = false;

  constructor(
    private readonly table: FieldTable,
    private readonly fleet: Fleet,
    { hands, asked, changed }: ResultOptions,
  ) {
    const rest = (): void => {
      this.at = this.playback.time;
      changed();
    };
    this.playback = new Playback({ point: (index) => this.point(index), rest });
    this.charts = new FieldCharts({
      spec: (field) => this.spec(field),
      hands: { ...hands, pick: rest },
      onCursor: (index) => (index === null ? this.leave() : this.read(index)),
      onFields: () => {
        this.wanted = this.charts.fields;
        changed();
      },
      sync: "history",
      usual: USUAL,
      most: MOST_CHARTS,
    });
    this.charts.node.classList.add("three");
    this.pictures = new Pictures(table);
    this.node.append(
      this.playback.node,
      this.pictures.node,
      this.charts.chips,
      this.charts.node,
      new Download(asked).node,
      this.comparison.node,
    );
  }

  set(robot: string, stream: string, drive: HistoryAnswer, range: Range): void {
    [this.robot, this.stream, this.drive] = [robot, stream, drive];
    this.node.hidden = false;
    const claims = this.pictures.set(drive);
    // The speed of the car is shown as the field speed, where its parameters are known.
    if (this.spec("speed").unit === "m/s" && Object.hasOwn(drive.fields, "speed")) claims.add("speed_mps");
    const fields = Object.keys(drive.fields).filter((field) => !claims.has(field));
    this.charts.set(this.charted(drive, fields), range, this.wanted);
    this.comparison.of(fields.map((field) => [field, this.spec(field)]));
    this.playback.set(drive.times_s);
    this.return();
  }

  clear(): void {
    this.playback.set([]);
    this.charts.clear();
    this.drive = undefined;
    this.node.hidden = true;
  }

  /** Show another range of the same samples. */
  move(range: Range): void {
    this.charts.move(range);
  }

  /** Mark times on the charts. */
  mark(marks: readonly Mark[]): void {
    this.charts.mark(marks);
  }

  stop(): void {
    this.playback.stop();
  }

  /** Show the newest live values. */
  clock(): void {
    if (this.drive) this.comparison.now(this.fleet.robots.get(this.robot)?.streams.get(this.stream));
  }

  /** The fields with numbers, as they are shown. */
  private charted({ times_s, fields, row_s }: HistoryAnswer, names: readonly string[]): Charted {
    const columns = names.flatMap((name) => {
      const { mean, least, most } = fields[name]!;
      if (!mean.some((value) => typeof value === "number")) return [];
      const each = least !== undefined && most !== undefined ? [mean, least, most] : [mean];
      return [[name, each.map((values) => numbers(values, this.spec(name)))] as const];
    });
    return { x: times_s, hole: Math.max(1, row_s * 2.5), fields: new Map(columns), names: [""] };
  }

  private spec(field: string): Spec {
    return asSpeed(
      field,
      spec(field, this.table, this.drive?.ros2, this.stream),
      this.fleet.speed(this.robot),
    );
  }

  /** Put the cursor where the viewer left it, or at the end. */
  private return(): void {
    const times = this.drive?.times_s ?? [];
    const after = times.findIndex((time) => time >= this.at - 1e-3);
    this.point(after < 0 ? times.length - 1 : after);
  }

  /** The pointer has left the charts, which all say so. */
  private leave(): void {
    if (this.left || Number.isNaN(this.at) || this.playback.playing) return;
    this.left = true;
    queueMicrotask(() => {
      this.left = false;
      this.return();
    });
  }

  /** Scrub to a row: in every chart, in the table and on the slider. */
  private point(index: number): void {
    this.charts.point(index);
    // After the charts, whose cursor is elsewhere until then.
    queueMicrotask(() => this.read(index));
  }

  private read(index: number): void {
    const { drive } = this;
    if (drive?.times_s[index] === undefined) return;
    this.playback.show(index);
    this.charts.read(index);
    this.pictures.point(drive, index);
    this.comparison.compare(
      new Map(Object.entries(drive.fields).map(([field, { mean }]) => [field, mean[index] ?? null])),
    );
  }
}
