// A car's past: a range from the cloud's table, to zoom into, to play, to save, and to compare with the live values.

import type {
  FieldsAnswer,
  HistoryAnswer,
  RacelineAnswer,
  RunsAnswer,
  StreamsAnswer,
} from "../base/contract";
import { el, Text, unserved } from "../base/dom";
import { age, number, when } from "../base/format";
import { inUs, LEAST_S, type Range, readRange, readTime, rounded, same, writeTime } from "../base/range";
import { type Query, type RouteTo, route, setAddress } from "../base/route";
import type { Mark } from "../charts/range_chart";
import type { Track } from "../charts/xy_chart";
import { AlarmsPanel } from "../history/alarms_panel";
import { LapsList } from "../history/laps_list";
import { fromArchive, unread } from "../history/origin";
import { Past } from "../history/past";
import { RangeForm } from "../history/range_form";
import { Result } from "../history/result";
import { RunsList } from "../history/runs_list";
import { GLANCE_HZ, type Looks } from "../link/viewing";
import { ask, Latest, words } from "../server/answers";
import { foxglove } from "../widgets/foxglove";
import { IncidentsPanel, letter } from "../widgets/incidents_panel";
import { NotesPanel } from "../widgets/notes_panel";
import { type Services, type View, viewNode } from "./view";

// What is shown first, unless nothing was stored in it.
const RECENT_S = 300;
const RUNS = 20;
// Panning loads once it has stopped for this long.
const SETTLED_MS = 200;
const UNSERVED =
  "This page was put on the web as it is, and cannot read the tables. To look into the past, run `iort dashboard` on a machine with access to the cloud, or `iort query`.";

export class HistoryView implements View<RouteTo<"history">> {
  readonly node: HTMLElement;
  private readonly name = new Text("car-name", "h2");
  private readonly live = el("a", { class: "tool" }, "Live");
  private readonly insights = el("a", { class: "tool" }, "Insights");
  private readonly foxglove = foxglove(() => {
    const shown = this.range
      ? `--from ${writeTime(this.range[0])} --to ${writeTime(this.range[1])}`
      : "--last 1h";
    return `${this.robot} ${shown}`;
  }, "Open this range in Foxglove");
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly form: RangeForm;
  private readonly runs = new RunsList((before_us) => void this.findRuns(before_us));
  private readonly result: Result;
  private readonly notes: NotesPanel;
  private readonly incidents: IncidentsPanel;
  private readonly alarms: AlarmsPanel;
  private readonly laps: LapsList;
  /** The fields of the robot's streams, and the samples of the range, by stream with the rows that were asked for. */
  private known: FieldsAnswer["streams"] = {};
  private drives = new Map<string, { readonly rows: number; readonly drive: HistoryAnswer }>();
  /** People's notes have numbers, incidents have letters. */
  private marks: { readonly notes: readonly Mark[]; readonly incidents: readonly Mark[] } = {
    notes: [],
    incidents: [],
  };
  private robot = "";
  private range: Range | undefined;
  /** The ranges from which the viewer zoomed in. */
  private zooms: Range[] = [];
  private readonly loading = new Latest();
  private settling: number | undefined;

  constructor(private readonly services: Services) {
    const { config, table, fleet } = services;
    this.form = new RangeForm({
      range: (range) => this.open(range),
      wrong: (text) => this.note.set(text),
      last: (seconds) => this.open(recent(seconds)),
      stream: () => this.choose(this.form.stream),
      out: () => this.zoomOut(),
    });
    this.result = new Result({
      config,
      table,
      fleet,
      hands: {
        zoom: (to) => this.zoom(to),
        move: (to, upright) => this.move(to, upright),
        back: () => this.zoomOut(),
      },
      range: () => this.range!,
      asked: () => this.asked(this.form.stream),
      line: config.track && config.answers ? raceline() : Promise.resolve(undefined),
      changed: () => {
        this.write();
        if (this.lacking().length > 0) void this.load(this.range!, this.drives);
      },
      alarmed: () => void this.alarms.show(this.robot),
    });
    this.alarms = new AlarmsPanel(config);
    this.laps = new LapsList({
      asked: () => [this.robot, this.zooms[0] ?? this.range!],
      zoom: (to) => this.lap(to),
      out: () => this.zoomOut(),
    });
    this.notes = new NotesPanel(config, {
      at: () => (Number.isNaN(this.result.at) ? Math.min(this.range![1], Date.now() / 1000) : this.result.at),
      shown: (notes) =>
        this.mark({ notes: notes.map(({ t_us }, i) => ({ at: t_us / 1e6, label: String(i + 1) })) }),
    });
    this.incidents = new IncidentsPanel(config, {
      shown: (incidents) =>
        this.mark({
          incidents: incidents.map(({ from_us, to_us }, i) => ({
            at: from_us / 1e6,
            to: to_us / 1e6,
            label: letter(i),
          })),
        }),
    });
    const served = [
      this.form.node,
      el("div", { class: "history-lists" }, this.runs.node, this.laps.node),
      el("div", { class: "history-status" }, this.note.node, this.form.out),
      this.result.node,
      this.alarms.node,
      this.notes.node,
      this.incidents.node,
    ];
    const beside = [
      el("p", { class: "car-state" }, "history"),
      el("p", { class: "tools" }, this.live, this.insights, this.foxglove),
    ];
    this.node = viewNode(
      "history",
      this.name.node,
      beside,
      ...(config.answers ? served : [unserved(UNSERVED)]),
    );
  }

  title({ robot }: RouteTo<"history">): string {
    return `${robot} · iort`;
  }

  looks(): Looks {
    return new Map([[this.robot, GLANCE_HZ]]);
  }

  leave(): void {
    this.result.stop();
    this.loading.stop();
    this.incidents.stop();
  }

  show({ robot, query = {} }: RouteTo<"history">): void {
    this.result.stop();
    if (robot === this.robot && this.range) {
      this.follow(query);
      return;
    }
    this.loading.stop();
    this.robot = robot;
    this.name.set(robot);
    this.live.href = route({ view: "car", robot });
    this.insights.href = route({ view: "insights", robot });
    [this.range, this.zooms] = [undefined, []];
    this.result.clear();
    this.note.set("");
    this.runs.set(robot, undefined);
    this.known = {};
    this.drives.clear();
    this.form.node.inert = true;
    if (!this.services.config.answers) return;
    void this.alarms.show(robot);
    void this.enter(robot, query);
  }

  private mark(changed: Partial<typeof this.marks>): void {
    this.marks = { ...this.marks, ...changed };
    this.result.mark([...this.marks.incidents, ...this.marks.notes]);
  }

  clock(): void {
    this.result.clock();
  }

  /** Find the robot's streams and runs, and show what the address says, or the newest. */
  private async enter(robot: string, query: Query<"history">): Promise<void> {
    const runs = this.findRuns();
    const fields = this.findFields(robot);
    this.note.set("Looking for what is stored …");
    await this.loading.run(
      async (signal) => {
        const { streams } = await ask<StreamsAnswer>("streams", { robot }, signal);
        const stream = [query.stream, this.services.table.stream, streams[0]].find(
          (name) => name !== undefined && streams.includes(name),
        );
        this.form.node.hidden = stream === undefined;
        if (stream === undefined) {
          this.note.set("Nothing of this car is stored.");
          return;
        }
        this.form.node.inert = false;
        this.form.streams(streams);
        this.form.stream = stream;
        this.runs.show(stream);
        this.result.read(stream, query.fields);
        this.result.at = readTime(query.at);
        const range = readRange(query.from, query.to);
        if (!range) await runs;
        await fields;
        signal.throwIfAborted();
        this.go(range ?? this.newest());
      },
      (reason) => this.note.set(reason),
    );
  }

  /** Find the fields of the robot's streams; without them there are only those of the main one. */
  private async findFields(robot: string): Promise<void> {
    const { streams } = await ask<FieldsAnswer>("fields", { robot }).catch(() => ({ streams: {} }));
    if (robot !== this.robot) return;
    this.known = streams;
    // The viewer may have chosen a range meanwhile.
    if (this.drives.size > 0 && this.lacking().length > 0) void this.load(this.range!, this.drives);
  }

  /** List the runs, or older ones. Without them the view still shows ranges. */
  private async findRuns(before_us?: number): Promise<void> {
    const { robot } = this;
    try {
      const answer = await ask<RunsAnswer>("runs", {
        robot,
        count: String(RUNS),
        ...(before_us === undefined ? {} : { before_us: String(before_us) }),
      });
      if (robot !== this.robot) return;
      if (before_us === undefined) this.runs.set(robot, answer);
      else this.runs.add(answer);
    } catch (error) {
      if (robot === this.robot) this.runs.fail(words(error));
    }
  }

  /** The last minutes; the newest run, if it ended before them. */
  private newest(): Range {
    const last = recent(RECENT_S);
    const run = this.runs.newest(this.form.stream);
    if (!run) return last;
    return run[1] < last[0] ? run : [Math.max(last[0], run[0]), last[1]];
  }

  /** Follow the browser's Back and links to other ranges of this robot. */
  private follow(query: Query<"history">): void {
    const before = this.form.stream;
    if (query.stream !== undefined) this.form.stream = query.stream;
    if (this.form.stream !== before) this.runs.show(this.form.stream);
    if (query.fields !== undefined || this.form.stream !== before)
      this.result.read(this.form.stream, query.fields);
    if (query.at !== undefined) this.result.at = readTime(query.at);
    const range = readRange(query.from, query.to) ?? this.range!;
    if (same(range, this.zooms.at(-1))) this.zooms.pop();
    else if (!this.zooms.some(([from, to]) => from <= range[0] && range[1] <= to)) this.zooms = [];
    this.go(range);
  }

  private choose(stream: string): void {
    this.result.read(stream, undefined);
    this.zooms = [];
    this.runs.show(stream);
    this.go(this.range ?? this.newest(), true);
  }

  /** Show a range that the viewer asks for. */
  private open(range: Range): void {
    if (!(range[1] - range[0] >= LEAST_S)) {
      this.note.set("The range must begin before it ends.");
      return;
    }
    this.zooms = [];
    this.go(range, true);
  }

  private zoom(to: Range): void {
    this.zooms.push(this.range!);
    const lacking = LEAST_S - (to[1] - to[0]);
    this.go(lacking > 0 ? [to[0] - lacking / 2, to[1] + lacking / 2] : to, true);
  }

  /** Show a lap alone; the laps of the range stay those to choose from. */
  private lap(to: Range): void {
    if (this.zooms.length === 0) this.zooms.push(this.range!);
    this.go(to, true);
  }

  private zoomOut(): void {
    const before = this.zooms.pop();
    if (before) this.go(before, true);
  }

  private move(to: Range, upright: boolean): boolean {
    const shown = this.range!;
    if (upright && this.zooms.length === 0) return false;
    const [least, most] = this.runs.extent(this.form.stream) ?? [-Infinity, Infinity];
    const span = to[1] - to[0];
    // What is stored stays in sight.
    if (span < LEAST_S || to[1] < least || to[0] > most) return false;
    if (this.zooms.length === 0) this.zooms.push(shown);
    this.range = rounded(to);
    this.result.move(this.range);
    this.form.show(this.range, true);
    window.clearTimeout(this.settling);
    this.settling = window.setTimeout(() => this.go(this.range!), SETTLED_MS);
    return true;
  }

  /** Show a range, and load what is stored in it; `step` makes it a step of the browser's history. */
  private go(range: Range, step = false): void {
    window.clearTimeout(this.settling);
    this.range = rounded(range);
    if (!(this.range[0] <= this.result.at && this.result.at <= this.range[1])) this.result.at = NaN;
    this.result.move(this.range);
    this.form.show(this.range, this.zooms.length > 0);
    this.laps.show(this.range);
    this.write(step);
    void this.load(this.range);
  }

  /** Put what is shown into the address. */
  private write(step = false): void {
    const [from, to] = this.range!.map(writeTime) as [string, string];
    const more = {
      ...(this.result.wanted.length > 0 ? { fields: this.result.wanted.join(",") } : {}),
      ...(Number.isNaN(this.result.at) ? {} : { at: writeTime(this.result.at) }),
    };
    setAddress(
      { view: "history", robot: this.robot, query: { stream: this.form.stream, from, to, ...more } },
      step,
    );
  }

  private asked(stream: string): Readonly<Record<string, string>> {
    return { robot: this.robot, stream, ...inUs(this.range!) };
  }

  /** The streams that the panels need, and that are not loaded, or in fewer rows. */
  private lacking(): (readonly [stream: string, rows: number])[] {
    const { stream } = this.form;
    const known = (name: string): boolean => name === stream || Object.hasOwn(this.known, name);
    return [...this.result.needs(stream, this.known)].filter(
      ([name, rows]) => known(name) && (this.drives.get(name)?.rows ?? 0) < rows,
    );
  }

  /** Load what the panels need of a range, beside what is `there`. */
  private async load(range: Range, there: typeof this.drives = new Map()): Promise<void> {
    this.drives = there;
    if (there.size === 0) {
      void this.notes.show(this.robot, range);
      this.incidents.show(this.robot, range);
    }
    this.note.set("Loading …");
    const began = performance.now();
    const { stream: main } = this.form;
    await this.loading.run(
      async (signal) => {
        const each = this.lacking().map(async ([stream, rows]) => {
          const asked = { ...this.asked(stream), rows: String(rows) };
          const drive = await ask<HistoryAnswer>("history", asked, signal);
          return [stream, { rows, drive }] as const;
        });
        for (const [stream, answer] of await Promise.all(each)) there.set(stream, answer);
        const drives = new Map([...there].map(([stream, { drive }]) => [stream, drive]));
        const { table, fleet } = this.services;
        const past = new Past(table, fleet, this.robot, main, this.known, drives);
        const drive = drives.get(main)!;
        if ([...drives.values()].every(({ samples }) => samples === 0)) this.result.clear();
        else this.result.set(past, range);
        const after_s = (performance.now() - began) / 1000;
        this.note.set(drive.samples === 0 ? this.nothing() : about(drive, range, after_s));
        // The fields of the streams came meanwhile, or other panels.
        if (this.lacking().length > 0) void this.load(range, there);
      },
      (reason) => this.note.set(reason),
    );
  }

  private nothing(): string {
    const extent = this.runs.extent(this.form.stream);
    const [from, to] = extent?.map((at) => when(at)) ?? [];
    return `Nothing was stored in this range.${extent ? ` ${this.form.stream} is stored from ${from} to ${to}.` : ""}`;
  }
}

/** The fastest line on the page's track; undefined if there is none. */
async function raceline(): Promise<Track | undefined> {
  try {
    const { x_m, y_m } = await ask<RacelineAnswer>("raceline", {});
    // It is closed.
    return x_m.length > 0 ? { x: [...x_m, x_m[0]!], y: [...y_m, y_m[0]!] } : undefined;
  } catch {
    return undefined;
  }
}

function recent(seconds: number): Range {
  const to = Math.ceil(Date.now() / 1000);
  return [to - seconds, to];
}

/** What an answer is made of. */
function about(drive: HistoryAnswer, range: Range, after_s: number): string {
  const { samples, row_s } = drive;
  const row = row_s < 1 ? `${number(row_s * 1000, 0)} ms` : age(row_s);
  const averaged = row_s > 0 ? `, averaged per ${row}, band = min to max` : "";
  const origin = fromArchive(drive.archive, range) + unread(drive);
  return `${number(samples)} samples in ${age(after_s)}${averaged}.${origin}`;
}
