// A car's past: a range from the cloud's table, to scrub through and to compare with the live values.

import type { Config, HistoryAnswer, FieldTable } from "../base/contract";
import { ask, AnswerError } from "../server/answers";
import { claim, claimed, partsOf } from "../live/attachments";
import { el, setAttribute, Text } from "../base/dom";
import type { Fleet } from "../live/fleet";
import { age, asSpeed, dayTime, linear, number, spec, zone, type Spec } from "../base/format";
import { Thumbnail } from "../widgets/thumbnail";
import { route, setAddress, type Query } from "../base/route";
import { RangeChart } from "../charts/range_chart";
import { Comparison } from "../widgets/comparison";

const RANGES = [["1 min", 60], ["5 min", 300], ["15 min", 900], ["1 h", 3600]] as const;
const FIRST_FIELDS = ["speed", "voltage_input", "current_motor", "current_input", "duty_cycle", "temperature_pcb"];
const MOST_CHARTS = 12;
// The rows of a request: about the width of a chart in points.
const ROWS = 1500;
const STEP_MS = 100;

export class HistoryView {
  readonly node: HTMLElement;
  private readonly title = new Text("car-name", "h2");
  private readonly back = el("a", { class: "tool" }, "Live");
  private readonly from = el("input", { type: "datetime-local", step: "1", id: "from", name: "from" });
  private readonly to = el("input", { type: "datetime-local", step: "1", id: "to", name: "to" });
  private readonly zone = new Text("zone");
  private readonly stream = el("select", { id: "stream", name: "stream" });
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly result = el("div", { class: "result", hidden: "" });
  private readonly scrub = el("input", { type: "range", min: "0", value: "0", class: "scrub", "aria-label": "Time within the range" });
  private readonly at = new Text("num scrub-at");
  private readonly play = el("button", { type: "button", class: "tool play" }, "Play");
  private readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Fields to chart" });
  private readonly charts = el("div", { class: "charts three" });
  private readonly pictures = el("div", { class: "tiles pictures" });
  private readonly comparison: Comparison;
  /** For each field of bytes its thumbnail, and the rows that have one. */
  private readonly kept = new Map<string, { readonly picture: Thumbnail; readonly rows: readonly number[] }>();
  private readonly shown = new Map<string, { readonly node: HTMLElement; readonly chart: RangeChart }>();
  private robot: string | undefined;
  private query: Query<"history"> = {};
  private drive: HistoryAnswer | undefined;
  private loading: AbortController | undefined;
  private playing: number | undefined;

  constructor(
    private readonly config: Config,
    private readonly table: FieldTable,
    private readonly fleet: Fleet,
  ) {
    this.comparison = new Comparison();
    const form = el(
      "form",
      { class: "range" },
      ...RANGES.map(([label, seconds]) => {
        const button = el("button", { type: "button", class: "tool" }, `Last ${label}`);
        button.addEventListener("click", () => this.last(seconds));
        return button;
      }),
      el("label", {}, "from ", this.from),
      el("label", {}, "to ", this.to, " ", this.zone.node),
      el("label", {}, "stream ", this.stream),
      el("button", { type: "submit", class: "tool primary" }, "Load"),
    );
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.load(seconds(this.from), seconds(this.to));
    });
    this.stream.addEventListener("change", () => {
      setAddress({ view: "history", robot: this.robot!, query: { stream: this.stream.value } });
      form.requestSubmit();
    });
    for (const each of [this.from, this.to]) each.addEventListener("input", () => this.sayZone());
    this.scrub.addEventListener("input", () => this.point(Number(this.scrub.value)));
    this.play.addEventListener("click", () => (this.playing === undefined ? this.start() : this.stop()));
    this.result.append(el("div", { class: "scrubber" }, this.play, this.scrub, this.at.node), this.pictures, this.chips, this.charts, this.comparison.node);
    const served = [form, this.note.node, this.result];
    const told = el("p", { class: "unserved" }, "This page was put on the web as it is, and cannot read the tables. To look into the past, run ", el("code", {}, "iort dashboard"), " on a machine with access to the cloud, or ", el("code", {}, "iort query"), ".");
    this.node = el(
      "article",
      { class: "history" },
      el("header", { class: "car-head" }, this.title.node, el("p", { class: "car-state" }, "history"), el("p", { class: "tools" }, this.back)),
      ...(config.answers ? served : [told]),
    );
  }

  /** Show a robot's past; undefined when the viewer leaves. */
  show(robot: string | undefined, query: Query<"history"> = {}): void {
    this.query = query;
    if (robot === undefined || robot !== this.robot) {
      this.stop();
      this.loading?.abort();
    }
    if (robot === undefined || robot === this.robot) return;
    this.robot = robot;
    this.title.set(robot);
    this.back.href = route({ view: "car", robot });
    this.clear();
    this.note.set("");
    if (!this.config.answers) return;
    void this.findStreams(robot);
  }

  clock(_now: number): void {
    if (this.drive) this.comparison.now(this.fleet.robots.get(this.robot ?? "")?.streams.get(this.stream.value));
  }

  private async findStreams(robot: string): Promise<void> {
    try {
      const { streams } = await ask<{ streams: string[] }>("streams", { robot });
      if (robot !== this.robot) return;
      const wanted = [this.query.stream, this.table.stream].find((name) => name !== undefined && streams.includes(name));
      const chosen = wanted ?? streams[0];
      this.stream.replaceChildren(...streams.map((name) => el("option", { value: name }, name)));
      if (chosen === undefined) this.note.set("Nothing of this car is stored.");
      else {
        this.stream.value = chosen;
        this.last(RANGES[1][1]);
      }
    } catch (error) {
      this.note.set(words(error));
    }
  }

  private last(range_s: number): void {
    const to = Math.ceil(Date.now() / 1000);
    this.from.value = local(to - range_s);
    this.to.value = local(to);
    this.sayZone();
    void this.load(to - range_s, to);
  }

  /** Show the time zone of the form's times; it may change with the season. */
  private sayZone(): void {
    const zones = [this.from, this.to].map(seconds).filter((at) => !Number.isNaN(at)).map(zone);
    this.zone.set([...new Set(zones)].join(" to "));
  }

  private async load(from_s: number, to_s: number): Promise<void> {
    if (!(from_s < to_s)) {
      this.note.set("The range must begin before it ends.");
      return;
    }
    this.loading?.abort();
    const loading = new AbortController();
    this.loading = loading;
    this.note.set("Loading …");
    const began = performance.now();
    try {
      const asked = { robot: this.robot!, stream: this.stream.value, from_us: String(from_s * 1e6), to_us: String(to_s * 1e6), rows: String(ROWS) };
      const drive = await ask<HistoryAnswer>("history", asked, loading.signal);
      if (loading.signal.aborted) return;
      this.set(drive, [from_s, to_s]);
      const each = drive.row_s > 0 ? `, averaged per ${drive.row_s < 1 ? `${number(drive.row_s * 1000, 0)} ms` : age(drive.row_s)}, band = min to max` : "";
      this.note.set(drive.samples === 0 ? "Nothing was stored in this range." : `${number(drive.samples)} samples in ${age((performance.now() - began) / 1000)}${each}.`);
    } catch (error) {
      if (!loading.signal.aborted) this.note.set(words(error));
    }
  }

  private clear(): void {
    this.stop();
    this.drive = undefined;
    for (const { chart } of this.shown.values()) chart.destroy();
    this.shown.clear();
    this.charts.replaceChildren();
    this.result.hidden = true;
  }

  private set(drive: HistoryAnswer, asked: readonly [number, number]): void {
    const before = new Set(this.shown.keys());
    this.clear();
    if (drive.samples === 0) return;
    this.drive = drive;
    this.result.hidden = false;
    const fields = this.look(drive);
    const charted = fields.filter((field) => drive.fields[field]!.mean.some((value) => typeof value === "number"));
    const wanted = charted.filter((field) => (before.size > 0 ? before.has(field) : FIRST_FIELDS.includes(field)));
    const [first, last] = [drive.times_s[0]!, drive.times_s.at(-1)!];
    // The data may cover only a part of the requested range.
    const range: readonly [number, number] = [Math.max(asked[0], first - 0.5), Math.min(asked[1], last + 0.5)];
    this.chips.replaceChildren(
      ...charted.map((field) => {
        const chip = el("button", { type: "button", class: "chip", "aria-pressed": "false", title: field }, spec(field, this.table).label);
        const toggle = (): void => {
          this.toggle(field, range);
          setAttribute(chip, "aria-pressed", String(this.shown.has(field)));
        };
        chip.addEventListener("click", toggle);
        if ((wanted.length > 0 ? wanted : charted.slice(0, 6)).includes(field)) toggle();
        return chip;
      }),
    );
    this.comparison.of(fields.map((field) => [field, this.spec(field)]));
    this.scrub.max = String(drive.times_s.length - 1);
    this.point(drive.times_s.length - 1);
  }

  private spec(field: string): Spec {
    return asSpeed(field, spec(field, this.table, this.drive?.ros2, this.stream.value), this.fleet.speed(this.robot ?? ""));
  }

  /** Make thumbnails for the fields of bytes, and return the other fields. */
  private look(drive: HistoryAnswer): string[] {
    const all = new Map(Object.entries(drive.fields));
    const ofBytes = claimed(all);
    this.kept.clear();
    for (const field of ofBytes) {
      const keys = drive.fields[`${field}.key`]!.mean;
      const rows = [...keys.keys()].filter((row) => keys[row] !== null);
      this.kept.set(field, { picture: new Thumbnail(spec(field, this.table).label, field), rows });
    }
    this.pictures.replaceChildren(...[...this.kept.values()].map(({ picture }) => picture.node));
    const claims = new Set(ofBytes.flatMap(partsOf));
    // The car's speed, where the motor's is not shown as it already.
    if (this.spec("speed").unit === "m/s" && all.has("speed")) claims.add("speed_mps");
    return [...all.keys()].filter((field) => !claims.has(field));
  }

  private toggle(field: string, range: readonly [number, number]): void {
    const old = this.shown.get(field);
    if (old) {
      old.chart.destroy();
      old.node.remove();
      this.shown.delete(field);
      return;
    }
    const drive = this.drive!;
    if (this.shown.size >= MOST_CHARTS) return;
    const as = this.spec(field);
    const { label, unit } = as;
    const { mean, least, most } = drive.fields[field]!;
    const scaled = (values: HistoryAnswer["fields"][string]["mean"]): (number | null)[] => values.map((value) => (typeof value === "number" ? linear(value, as) : null));
    const plot = el("div", { class: "plot", "aria-hidden": "true" });
    const node = el("section", { class: "panel", "aria-label": label }, el("header", {}, el("h3", {}, label), el("p", { class: "reading" }, el("span", { class: "unit" }, unit))), plot);
    this.charts.append(node);
    const band = least !== undefined && most !== undefined;
    const chart = new RangeChart(
      plot,
      {
        curves: [{ label, colour: "--accent" }],
        sync: "history",
        hole_s: Math.max(1, drive.row_s * 2.5),
        band,
        onCursor: (index) => index !== null && this.read(index),
      },
      [[...drive.times_s], scaled(mean), ...(band ? [scaled(least), scaled(most)] : [])],
      range,
    );
    this.shown.set(field, { node, chart });
  }

  /** Scrub to a row: in every chart, in the table and on the slider. */
  private point(index: number): void {
    this.scrub.value = String(index);
    for (const { chart } of this.shown.values()) chart.point(index);
    this.read(index);
  }

  private read(index: number): void {
    const { drive } = this;
    const at = drive?.times_s[index];
    if (!drive || at === undefined) return;
    this.scrub.value = String(index);
    const text = `${dayTime(at, { fractionalSecondDigits: 1 })} ${zone(at)}`;
    this.at.set(text);
    setAttribute(this.scrub, "aria-valuetext", text);
    for (const [field, { picture, rows }] of this.kept) {
      // The newest thumbnail of that time; before the first one, the first.
      const row = rows.findLast((each) => each <= index) ?? rows[0];
      if (row === undefined) continue;
      picture.set(claim(field, (name) => drive.fields[name]?.mean[row] ?? null));
      const away = drive.times_s[row]! - at;
      picture.when(away > 0 ? `${age(away)} later` : `${age(-away)} before`);
    }
    this.comparison.then(new Map(Object.entries(drive.fields).map(([field, { mean }]) => [field, mean[index] ?? null])));
  }

  /** Play the range as fast as it was driven. */
  private start(): void {
    const { drive } = this;
    if (!drive) return;
    let index = Number(this.scrub.value);
    if (index >= drive.times_s.length - 1) index = 0;
    const [began, first] = [performance.now() / 1000, drive.times_s[index]!];
    this.play.textContent = "Pause";
    this.playing = window.setInterval(() => {
      const at = first + performance.now() / 1000 - began;
      while (index < drive.times_s.length - 1 && drive.times_s[index + 1]! <= at) index += 1;
      this.point(index);
      if (index >= drive.times_s.length - 1) this.stop();
    }, STEP_MS);
  }

  private stop(): void {
    window.clearInterval(this.playing);
    this.playing = undefined;
    this.play.textContent = "Play";
  }
}

function words(error: unknown): string {
  return error instanceof AnswerError ? error.message : `The answer could not be read: ${String(error)}`;
}

/** A time in the input's format, in this device's time zone. */
function local(at: number): string {
  return new Date((at - new Date(at * 1000).getTimezoneOffset() * 60) * 1000).toISOString().slice(0, 19);
}

function seconds(input: HTMLInputElement): number {
  return new Date(input.value).getTime() / 1000;
}
