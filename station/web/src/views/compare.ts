// Two to six runs, laps or robots on one axis: the time since each began, or the distance since then.

import type { StreamsAnswer } from "../base/contract";
import { button, choices, el, Text, unserved } from "../base/dom";
import { age, clockTime, number, when, zone } from "../base/format";
import { type Range, same, writeTime } from "../base/range";
import { MOST_PARTS, type Part, type RouteTo, readParts, route, setAddress, writeParts } from "../base/route";
import { key, type Lines } from "../charts/lines_panel";
import { AddPart } from "../history/add_part";
import type { Axis } from "../history/align";
import { Chart, lineOf } from "../history/chart";
import { chosen, Panels } from "../history/panels";
import { type Charted, NoDistance, Parts } from "../history/parts";
import { ask, Latest } from "../server/answers";
import { type Services, type View, viewNode } from "./view";

const SETTLED_MS = 200;
const AXES = [
  ["time", "Time since the start"],
  ["distance", "Distance"],
] as const;
const USUAL = ["speed", "current_motor", "duty_cycle", "voltage_input"];
const [FIRST_CHARTS, MOST_CHARTS] = [6, 8];
const UNSERVED =
  "This page was put on the web as it is, and cannot read the tables. To compare runs, run `iort dashboard`.";

export class CompareView implements View<RouteTo<"compare">> {
  readonly node: HTMLElement;
  private readonly stream = el("select", { id: "compare-stream" });
  private readonly axis = el("select", { id: "compare-axis" }, ...choices(AXES));
  private readonly out = button("Zoom out", () => this.back(), {
    hidden: "",
    title: "Also: a double click on a chart",
  });
  private readonly note = new Text("history-note", "p", { role: "status" });
  private readonly at = new Text("num");
  private readonly list = el("ul", { class: "parts" });
  private readonly charts: Panels<Charted>;
  private readonly add: AddPart;
  private readonly loader: Parts;
  private parts: readonly Part[] = [];
  private wanted: readonly string[] = [];
  private unit = "";
  private extent: Range = [0, 1];
  private zooms: Range[] = [];
  private zoom: Range | undefined;
  private readonly loading = new Latest();
  private settling: number | undefined;

  constructor(private readonly services: Services) {
    const { config, table, fleet } = services;
    this.loader = new Parts(table, fleet);
    this.add = new AddPart(fleet, (part) => this.include(part));
    const touch = {
      zoom: (to: Range) => this.go(to),
      move: (to: Range, upright: boolean) => this.move(to, upright),
      back: () => this.back(),
      pick: () => undefined,
      point: (at: number | null) => at !== null && this.read(at),
    };
    const label = (field: string): string => this.loader.spec(field, this.stream.value, this.parts).label;
    this.charts = new Panels({
      make: (field) =>
        new Chart({ title: label(field), touch, lines: (charted) => this.lines(field, charted) }),
      changed: () => {
        this.wanted = this.charts.keys;
        this.write();
      },
      most: MOST_CHARTS,
    });
    this.stream.addEventListener("change", () => this.restart());
    this.axis.addEventListener("change", () => this.restart());
    const form = el(
      "div",
      { class: "range" },
      el("label", {}, "stream ", this.stream),
      el("label", {}, "over ", this.axis),
    );
    const status = el("div", { class: "history-status" }, this.note.node, this.at.node, this.out);
    const served = [form, this.list, this.add.node, status, this.charts.chips, this.charts.node];
    this.node = viewNode(
      "history compare-view",
      "Compare",
      [],
      ...(config.answers ? served : [unserved(UNSERVED)]),
    );
  }

  title(): string {
    return "Compare · iort";
  }

  leave(): void {
    this.loading.stop();
  }

  show({ query = {} }: RouteTo<"compare">): void {
    if (!this.services.config.answers) return;
    this.parts = readParts(query.runs).slice(0, MOST_PARTS);
    this.wanted = query.fields?.split(",") ?? [];
    this.axis.value = query.x === "distance" ? "distance" : "time";
    const [from = NaN, to = NaN] = (query.zoom ?? "").split(",").map(Number);
    this.zoom = to > from ? [from, to] : undefined;
    this.zooms = [];
    void this.enter(query.stream ?? this.services.table.stream);
  }

  /** Find the streams of the first robot. */
  private async enter(stream: string): Promise<void> {
    this.stream.replaceChildren(el("option", {}, stream));
    const loaded = this.load();
    const robot = this.parts[0]?.robot;
    if (robot === undefined) return loaded;
    try {
      const { streams } = await ask<StreamsAnswer>("streams", { robot });
      const chosen = this.stream.value;
      this.stream.replaceChildren(...choices([...new Set([...streams, chosen])]));
      this.stream.value = chosen;
    } catch {
      // The request for the samples says why.
    }
    return loaded;
  }

  private include(part: Part): void {
    if (this.parts.some(({ robot, range }) => robot === part.robot && same(range, part.range)))
      this.note.set(`${named(part)} is compared already.`);
    else if (this.parts.length >= MOST_PARTS)
      this.note.set(`At most ${MOST_PARTS} runs can be compared: remove one first.`);
    else this.choose([...this.parts, part]);
  }

  private choose(parts: readonly Part[]): void {
    this.parts = parts;
    this.restart();
  }

  /** Show everything of other parts, of another stream, or over another axis. */
  private restart(): void {
    [this.zoom, this.zooms] = [undefined, []];
    this.write(true);
    void this.load();
  }

  private go(to: Range | undefined, step = true): void {
    window.clearTimeout(this.settling);
    if (step) this.zooms.push(this.zoom ?? this.extent);
    this.zoom = to;
    this.charts.move(to ?? this.extent);
    this.write();
    void this.load();
  }

  private back(): void {
    const before = this.zooms.pop();
    if (before || this.zoom)
      this.go(before && before[1] - before[0] < this.extent[1] - this.extent[0] ? before : undefined, false);
  }

  private move(to: Range, upright: boolean): boolean {
    const zoomed = this.zoom !== undefined;
    if ((upright && !zoomed) || to[1] <= this.extent[0] || to[0] >= this.extent[1] || to[1] - to[0] < 1e-3)
      return false;
    if (this.zooms.length === 0) this.zooms.push(this.zoom ?? this.extent);
    this.zoom = to;
    this.charts.move(to);
    window.clearTimeout(this.settling);
    this.settling = window.setTimeout(() => this.go(to, false), SETTLED_MS);
    return true;
  }

  private write(step = false): void {
    const query = {
      runs: writeParts(this.parts),
      stream: this.stream.value,
      x: this.axis.value,
      ...(this.wanted.length > 0 ? { fields: this.wanted.join(",") } : {}),
      ...(this.zoom ? { zoom: this.zoom.map((at) => at.toFixed(3)).join(",") } : {}),
    };
    setAddress({ view: "compare", query }, step);
  }

  private async load(): Promise<void> {
    const { parts, zoom } = this;
    const stream = this.stream.value;
    this.showParts();
    this.add.show(stream, [...new Set(parts.map(({ robot }) => robot))]);
    this.out.hidden = zoom === undefined;
    this.note.set(
      parts.length < 2 ? `Add ${parts.length === 0 ? "two runs" : "another run"} to compare.` : "Loading …",
    );
    await this.loading.run(
      async (signal) => {
        try {
          await this.draw(parts, stream, zoom, signal);
        } catch (error) {
          if (!(error instanceof NoDistance)) throw error;
          this.axis.value = "time";
          await this.draw(parts, stream, undefined, signal);
          this.note.set(
            `${error.message} has no distance in ${stream}: it needs a position, or the tachometer and the car's speed_to_erpm_gain. Shown over time.`,
          );
        }
      },
      (reason) => this.note.set(reason),
    );
  }

  private async draw(
    parts: readonly Part[],
    stream: string,
    zoom: Range | undefined,
    signal: AbortSignal,
  ): Promise<void> {
    const compared = await this.loader.load(parts, stream, this.axis.value as Axis, zoom, signal);
    signal.throwIfAborted();
    const { samples, archived, extent, ...charted } = compared;
    this.extent = extent;
    this.unit = charted.along;
    const fields = [...charted.fields.keys()];
    const labels = fields.map((field) => [field, this.loader.spec(field, stream, parts).label] as const);
    this.charts.show(
      { ...charted, names: shortly(parts) },
      zoom ?? extent,
      chosen(fields, this.wanted, USUAL, FIRST_CHARTS),
      new Map(labels),
    );
    if (parts.length >= 2)
      this.note.set(
        samples === 0
          ? "Nothing was stored in these ranges."
          : `${number(samples)} samples${archived ? ", some from the archive" : ""}.`,
      );
    this.read((zoom ?? extent)[0]);
  }

  /** A line for each part; of a single one, with its minimum and maximum. */
  private lines(field: string, { x, along, hole, fields, names }: Charted): Lines | undefined {
    const columns = fields.get(field);
    const spec = this.loader.spec(field, this.stream.value, this.parts);
    const lines = names.map((name) => lineOf(spec, names.length === 1 ? spec.label : name));
    return columns && { x, along, hole, columns, lines };
  }

  private showParts(): void {
    const stream = this.stream.value;
    this.list.replaceChildren(
      ...this.parts.map((part, i) => {
        const [from, to] = part.range;
        const others = this.parts.filter((_, other) => other !== i);
        const remove = button("×", () => this.choose(others), {
          class: "close",
          "aria-label": `Remove ${named(part)}`,
        });
        const query = { stream, from: writeTime(from), to: writeTime(to) };
        const link = el("a", { href: route({ view: "history", robot: part.robot, query }) }, named(part));
        return el(
          "li",
          { class: "panel" },
          key(i),
          link,
          el("span", { class: "note" }, age(to - from)),
          remove,
        );
      }),
    );
  }

  private read(at: number): void {
    this.at.set(this.parts.length === 0 ? "" : `at ${number(at, 2)} ${this.unit}`);
    this.charts.point(at);
  }
}

function named({ robot, range: [from] }: Part): string {
  return `${robot}, ${when(from)}`;
}

/** The shortest names that tell the parts apart: the robots, the times of day, or both. */
function shortly(parts: readonly Part[]): string[] {
  const robots = parts.map(({ robot }) => robot);
  const times = parts.map(({ range: [from] }) => `${clockTime(from)} ${zone(from)}`);
  const names =
    new Set(robots).size === parts.length
      ? robots
      : new Set(robots).size === 1
        ? times
        : robots.map((robot, i) => `${robot} ${times[i]!}`);
  return new Set(names).size === parts.length ? names : parts.map(named);
}
