// Where the robot was: the way of a stream with positions, in the colours of a field, on the track if there is one. And a
// field over another one, which is drawn on the same plane.

import { el, panel, Text } from "../base/dom";
import { AS_SENT, number, write as written } from "../base/format";
import type { Range } from "../base/range";
import { Plane, type PlaneOptions } from "../charts/plane";
import { extremes } from "../charts/spoken";
import type { Track } from "../charts/xy_chart";
import { fieldList } from "./chart";
import type { Panel, Touch } from "./panels";
import { keyOf, type Past, type Place } from "./past";

const MAP = "map";
const XY = "xy";
export const mapKey = (stream: string, colour = ""): string =>
  [MAP, stream, ...(colour ? [colour] : [])].join(":");
export const xyKey = (x: string, y: string): string => [XY, x, y].join(":");

/** The streams that a plane's key needs; undefined for the key of another panel. */
export function planeStreams(key: string, main: string): string[] | undefined {
  const [kind, one = "", other = ""] = key.split(":");
  const of = (field: string): string[] => (field ? [keyOf(field, main)[0]] : []);
  if (kind === MAP) return [one, ...of(other)];
  return kind === XY ? [...of(one), ...of(other)] : undefined;
}

export interface PlaneTools {
  readonly touch: Touch;
  /** The edges of the page's track; undefined without one, or for a stream of latitudes, which has another origin. */
  readonly ground: (stream: string) => readonly [Track, Track] | undefined;
  /** The fastest line on it, once it is known. */
  readonly line: Promise<Track | undefined>;
  /** The panel's key has changed. */
  readonly changed: (key: string) => void;
}

/** The panel of a key: `map:pose:speed` or `xy:speed:current_motor`; undefined for another key. */
export function planeOf(key: string, tools: PlaneTools): Panel<Past> | undefined {
  const [kind, one, other] = key.split(":");
  if (kind === MAP && one) return new Trajectory(one, other ?? "", tools);
  return kind === XY && one && other ? new FieldOverField(one, other, tools) : undefined;
}

/** What both have: the plane, its heading, and the choice of fields. */
abstract class OnPlane implements Panel<Past> {
  abstract readonly title: string;
  readonly node: HTMLElement;
  protected past: Past | undefined;
  protected readonly plane: Plane;
  protected readonly note = new Text("note");
  private readonly scale = el("p", { class: "ramp", hidden: "" });

  constructor(
    name: string,
    { touch }: PlaneTools,
    lists: readonly HTMLElement[],
    options: Pick<PlaneOptions, "dots" | "equal" | "ground">,
  ) {
    const host = el("div", { class: "plot" });
    const choice = el("span", { class: "panel-tools" }, ...lists);
    this.node = panel(name, `xy ${options.dots ? "" : "map"}`, [this.note.node, choice], this.scale, host);
    this.plane = new Plane(host, {
      ...{ title: name, x: () => this.axis(0), y: () => this.axis(1), ...options },
      span: options.equal ? [2, 2] : [1e-6, 1e-6],
      onPoint: touch.point,
      pick: touch.pick,
      told: (index) => this.told(index),
    });
    host.addEventListener("dblclick", touch.back);
  }

  abstract set(past: Past, range: Range): boolean;
  protected abstract axis(i: 0 | 1): string;
  protected abstract told(index: number): string;

  move(range: Range): void {
    this.plane.move(range);
  }

  point(at: number): void {
    this.plane.point(at);
  }

  destroy(): void {
    this.plane.destroy();
  }

  /** The colours of values from 0 to 1, with their legend below the heading. */
  protected shades(
    values: readonly number[],
    title: string,
    unit: string,
    digits: number | undefined,
  ): number[] | undefined {
    const { least, most } = extremes(values);
    this.scale.hidden = !(least <= most);
    if (this.scale.hidden) return undefined;
    const ends = [least, most].map((value) => el("span", { class: "num" }, number(value, digits)));
    this.scale.replaceChildren(
      el("span", { class: "label" }, title),
      ends[0]!,
      el("i", { "aria-hidden": "true" }),
      ends[1]!,
      ...(unit ? [el("span", { class: "unit" }, unit)] : []),
    );
    const span = most - least || 1;
    return values.map((value) => (value - least) / span);
  }

  /** The fields of the streams that are offered, with their labels. */
  protected offered(): Map<string, (readonly [string, string])[]> {
    const { past } = this;
    const all = past?.numeric() ?? new Map<string, readonly string[]>();
    return new Map(
      [...all].map(([stream, keys]) => [stream, keys.map((key) => [key, past!.spec(key).label] as const)]),
    );
  }

  protected value(key: string, value: number): string {
    const spec = this.past!.spec(key);
    return `${spec.label} ${written(value, { ...spec, ...AS_SENT })} ${spec.unit}`.trim();
  }
}

class Trajectory extends OnPlane {
  readonly title: string;
  private at: Place | undefined;
  private values: readonly number[] = [];

  constructor(
    private readonly stream: string,
    private colour: string,
    tools: PlaneTools,
  ) {
    const title = `Trajectory of ${stream}`;
    const list = fieldList(
      "Colour by a field",
      "Colour",
      () => new Map([["", [["-", "One colour"] as const]], ...this.offered()]),
      (key) => {
        this.colour = key === "-" ? "" : key;
        tools.changed(mapKey(stream, this.colour));
      },
    );
    const ground = tools.ground(stream);
    super(title, tools, [list], { equal: true, ...(ground ? { ground } : {}) });
    this.title = title;
    void tools.line.then((line) => this.plane.ground(line));
  }

  set(past: Past, range: Range): boolean {
    this.past = past;
    this.at = past.place(this.stream);
    if (!this.at) return false;
    const { colour } = this;
    const { label, unit, digits } = past.spec(colour);
    this.values = colour ? past.joined(colour, this.at.t) : [];
    const shades = this.shades(this.values, label, unit, digits);
    this.note.set(this.at.degrees ? "metres from its start" : "");
    this.plane.set({ ...this.at, shades, hole: past.hole(this.stream) }, range);
    return true;
  }

  protected axis(i: 0 | 1): string {
    return (this.at?.degrees ? ["east, m", "north, m"] : ["x, m", "y, m"])[i]!;
  }

  protected told(index: number): string {
    const { at, colour, values } = this;
    const [x, y] = [at!.x[index] ?? NaN, at!.y[index] ?? NaN];
    const more = colour ? `, ${this.value(colour, values[index] ?? NaN)}` : "";
    return `${this.axis(0)} ${number(x, 2)}, ${this.axis(1)} ${number(y, 2)}${more}`;
  }
}

class FieldOverField extends OnPlane {
  readonly title: string;
  private values: readonly (readonly number[])[] = [];

  constructor(
    private x: string,
    private y: string,
    tools: PlaneTools,
  ) {
    const choose = (axis: "x" | "y") => (key: string) => {
      this[axis] = key;
      tools.changed(xyKey(this.x, this.y));
    };
    const lists = (["x", "y"] as const).map((axis) =>
      fieldList(`The ${axis} axis`, axis, () => this.offered(), choose(axis)),
    );
    super("Field over field", tools, lists, { dots: true });
    this.title = "Field over field";
  }

  set(past: Past, range: Range): boolean {
    this.past = past;
    const [x, y] = [past.field(this.x), past.field(this.y)];
    if (!x || !y) return false;
    const across = x.columns[0]!.map((value) => value ?? NaN);
    this.values = [across, past.joined(this.y, x.x)];
    this.note.set(
      x.stream === y.stream ? "of the same sample" : `for each ${x.stream}, the last ${y.stream} before it`,
    );
    this.plane.set({ t: x.x, x: across, y: this.values[1]!, hole: past.hole(x.stream) }, range);
    return true;
  }

  protected axis(i: 0 | 1): string {
    const key = i === 0 ? this.x : this.y;
    if (!this.past) return "";
    const { unit } = this.past.spec(key);
    return `${this.past.label(key)}${unit ? `, ${unit}` : ""}`;
  }

  protected told(index: number): string {
    return [this.x, this.y].map((key, i) => this.value(key, this.values[i]![index] ?? NaN)).join(", ");
  }
}
