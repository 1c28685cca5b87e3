// What was stored in a range: its panels and pictures, with a playhead, a playback, and the live values beside it.

import type { Config, FieldsAnswer, FieldTable } from "../base/contract";
import { button, el, form } from "../base/dom";
import { keep, kept } from "../base/kept";
import { lastAt, type Range } from "../base/range";
import type { Hands, Mark } from "../charts/range_chart";
import { edges } from "../charts/track_map";
import type { Track } from "../charts/xy_chart";
import type { Fleet } from "../live/fleet";
import { may } from "../server/admission";
import { Comparison } from "../widgets/comparison";
import { AlarmForm } from "./alarm_form";
import { fieldList } from "./chart";
import { Download } from "./download";
import { fieldChart, fieldsOf } from "./field_chart";
import { chosen, type Panel, Panels, type Touch } from "./panels";
import { keyOf, type Past } from "./past";
import { Pictures } from "./pictures";
import { Playback } from "./playback";
import { RowsPanel, rowsKey, rowsStream } from "./rows_panel";
import { mapKey, planeOf, planeStreams, xyKey } from "./trajectory";

const USUAL = ["speed", "voltage_input", "current_motor", "current_input", "duty_cycle", "temperature_pcb"];
const FIRST = 6;
const MOST_PANELS = 12;
// The rows of a request: about the width of a chart in points; of a way, as many as the server gives.
const ROWS = 1500;
const MAP_ROWS = 5000;

export interface ResultOptions {
  readonly config: Config;
  readonly table: FieldTable;
  readonly fleet: Fleet;
  readonly hands: Omit<Hands, "pick">;
  readonly range: () => Range;
  /** The parameters of a download. */
  readonly asked: () => Readonly<Record<string, string>>;
  /** The fastest line on the page's track. */
  readonly line: Promise<Track | undefined>;
  /** The viewer has chosen other panels, or another time. */
  readonly changed: () => void;
  /** The robot has another trigger. */
  readonly alarmed: () => void;
}

export class Result {
  readonly node = el("div", { class: "result", hidden: "" });
  /** The panels that the viewer has chosen; empty for the usual ones. */
  wanted: readonly string[] = [];
  /** The time that the viewer rests at; NaN for the end. */
  at = NaN;
  private readonly playback: Playback;
  private readonly panels: Panels<Past>;
  private readonly pictures: Pictures;
  private readonly comparison = new Comparison();
  private readonly reset = button("Reset", () => this.choose([]), { title: "Show the usual panels" });
  private past: Past | undefined;
  /** Where the playhead is, and whether it is to be drawn. */
  private now = NaN;
  private drawing = false;

  constructor(private readonly options: ResultOptions) {
    const { config, hands } = options;
    const pick = (): void => {
      this.at = this.now;
      options.changed();
    };
    const touch: Touch = {
      ...hands,
      pick,
      point: (at) => (at === null ? this.leave() : this.point(at)),
    };
    const tools = {
      touch,
      ground: (stream: string) =>
        config.track === null || this.past?.known[stream]?.degrees ? undefined : edges(config.track),
      line: options.line,
    };
    this.playback = new Playback({ point: (index) => this.point(this.times[index] ?? NaN), rest: pick });
    this.panels = new Panels<Past>({
      make: (key) => this.make(key, touch, tools),
      most: MOST_PANELS,
      changed: () => this.choose(this.panels.keys),
    });
    this.panels.node.classList.add("three");
    this.pictures = new Pictures(options.table);
    const add = fieldList(
      "Add a panel",
      "Add a panel",
      () => this.offered(),
      (key) => this.panels.toggle(key),
    );
    add.classList.replace("pick", "tool");
    this.node.append(
      this.playback.node,
      this.pictures.node,
      el(
        "div",
        { class: "panel-choice" },
        this.panels.chips,
        form({ class: "range panel-add" }, () => undefined, add, this.reset),
      ),
      this.panels.node,
      new Download(options.asked).node,
      this.comparison.node,
    );
  }

  /** Take the panels of an address, or of the last visit. A link changes nothing that is kept. */
  read(main: string, fields: string | undefined): void {
    this.wanted = (fields ?? kept(keptName(main)) ?? "").split(",").filter(Boolean);
  }

  /** The streams of the panels, each with its rows. */
  needs(main: string, known: FieldsAnswer["streams"]): ReadonlyMap<string, number> {
    const rows = new Map([[main, ROWS]]);
    for (const key of this.wanted.length > 0 ? this.wanted : usualMap(main, known))
      for (const stream of streamsOf(key, main))
        rows.set(
          stream,
          key === mapKey(stream) || key.startsWith(`${mapKey(stream)}:`)
            ? MAP_ROWS
            : (rows.get(stream) ?? ROWS),
        );
    return rows;
  }

  set(past: Past, range: Range): void {
    this.past = past;
    this.node.hidden = false;
    const drive = past.drives.get(past.main);
    const fields = past.shown(past.main);
    if (drive) this.pictures.set(drive);
    this.comparison.of(fields.map((field) => [field, past.spec(field)]));
    this.playback.set(this.times);
    this.arrange(range);
    this.now = this.rest;
    this.draw();
  }

  clear(): void {
    this.playback.set([]);
    this.panels.clear();
    this.past = undefined;
    this.node.hidden = true;
  }

  /** Show another range of the same samples. */
  move(range: Range): void {
    this.panels.move(range);
  }

  /** Mark times on the charts. */
  mark(marks: readonly Mark[]): void {
    this.panels.mark(marks);
  }

  stop(): void {
    this.playback.stop();
  }

  /** Show the newest live values. */
  clock(): void {
    const { past } = this;
    if (past) this.comparison.now(this.options.fleet.robots.get(past.robot)?.streams.get(past.main));
  }

  private get times(): readonly number[] {
    return this.past?.drives.get(this.past.main)?.times_s ?? [];
  }

  /** Where the viewer left the playhead, or the end. */
  private get rest(): number {
    return Number.isNaN(this.at) ? (this.times.at(-1) ?? this.options.range()[1]) : this.at;
  }

  private arrange(range: Range): void {
    const past = this.past!;
    const fields = new Map(
      past
        .shown(past.main)
        .filter((field) => past.field(field))
        .map((field) => [field, past.spec(field).label] as const),
    );
    const others = this.wanted.filter((key) => /[:/~]/.test(key));
    const usual = chosen([...fields.keys()], [], USUAL, FIRST);
    const all = [...fields.keys(), ...others];
    const keys = chosen(all, this.wanted, [], 0);
    this.panels.show(
      past,
      range,
      keys.length > 0 ? keys : [...usualMap(past.main, past.known), ...usual],
      fields,
    );
    this.reset.hidden = this.wanted.length === 0;
  }

  /** The viewer has chosen these panels; none are the usual ones. */
  private choose(keys: readonly string[]): void {
    const { past } = this;
    if (!past) return;
    const before = this.wanted;
    this.wanted = [...keys];
    keep(keptName(past.main), this.wanted.join(","));
    if (keys.length === 0 && before.length > 0) this.arrange(this.options.range());
    this.reset.hidden = this.wanted.length === 0;
    this.draw();
    this.options.changed();
  }

  private make(
    key: string,
    touch: Touch,
    tools: Omit<Parameters<typeof planeOf>[1], "changed">,
  ): Panel<Past> | undefined {
    const changed = (to: string): void => this.panels.swap(key, to);
    const stream = rowsStream(key);
    if (stream) return new RowsPanel(stream, touch);
    const plane = planeOf(key, { ...tools, changed });
    if (plane || key.includes(":")) return plane;
    const past = (): Past | undefined => this.past;
    const chart = fieldChart(key, past, touch, changed);
    const { range, alarmed: added, config } = this.options;
    if (may(config, "add_trigger")) new AlarmForm(chart, fieldsOf(key), { past, range, added });
    return chart;
  }

  /** The panels that can be added, and the fields of the other streams; those of the main one are chips. */
  private offered(): Map<string, (readonly [string, string])[]> {
    const { past } = this;
    if (!past) return new Map();
    const all = past.numeric();
    const [x, y] = past.shown(past.main).filter((field) => past.field(field));
    const maps = Object.entries(past.known).flatMap(([stream, { position }]) =>
      position.length > 0 ? [[mapKey(stream), `Trajectory of ${stream}`] as const] : [],
    );
    const xy = x && y ? [[xyKey(x, y), "Field over field"] as const] : [];
    const tables = [...all.keys()].map((stream) => [rowsKey(stream), `Table of ${stream}`] as const);
    const groups = new Map<string, (readonly [string, string])[]>([["Panels", [...maps, ...xy, ...tables]]]);
    for (const [stream, keys] of all)
      if (stream !== past.main)
        groups.set(
          stream,
          keys.map((key) => [key, past.spec(key).label] as const),
        );
    return groups;
  }

  /** The pointer has left the panels. */
  private leave(): void {
    if (!Number.isNaN(this.at) && !this.playback.playing) this.point(this.at);
  }

  /** Move the playhead: in every panel, in the table and on the slider, with the next picture. */
  private point(at: number): void {
    this.now = at;
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => this.draw());
  }

  private draw(): void {
    this.drawing = false;
    const { past, now } = this;
    if (!past || Number.isNaN(now)) return;
    this.panels.point(now);
    const drive = past.drives.get(past.main);
    if (!drive || drive.times_s.length === 0) return;
    const row = lastAt(drive.times_s, now);
    this.playback.show(row);
    this.pictures.point(drive, row);
    this.comparison.compare(
      new Map(Object.entries(drive.fields).map(([field, { mean }]) => [field, mean[row] ?? null])),
    );
  }
}

/** The arrangement is of a stream: a fleet's robots are alike. */
const keptName = (main: string): string => `history.${main}`;

function streamsOf(key: string, main: string): readonly string[] {
  const rows = rowsStream(key);
  return rows ? [rows] : (planeStreams(key, main) ?? fieldsOf(key).map((field) => keyOf(field, main)[0]));
}

/** The way that is shown unless the viewer chooses: of the main stream, or of the first with positions. */
function usualMap(main: string, known: FieldsAnswer["streams"]): string[] {
  const placed = Object.keys(known).filter((stream) => known[stream]!.position.length > 0);
  const stream = placed.includes(main) ? main : placed.includes("pose") ? "pose" : placed[0];
  const speed = known[main]?.numbers.includes("speed") ? "speed" : "";
  return stream === undefined ? [] : [mapKey(stream, speed)];
}
