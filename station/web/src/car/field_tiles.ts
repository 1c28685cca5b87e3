// A stream's heading, and a tile for each of its fields: the newest value, its unit and its last 30 seconds. A field
// of bytes has its newest thumbnail.

import { type FieldTable, STALE_S } from "../base/contract";
import { button, el, setAttribute, Text } from "../base/dom";
import { age, type Spec, spec, write } from "../base/format";
import { Sparkline } from "../charts/sparkline";
import { claimed, partsOf } from "../live/attachments";
import { numeric, type Stream } from "../live/stream";
import { Thumbnail } from "../widgets/thumbnail";
import { fieldKey } from "./board_panels";

class Tile {
  readonly node: HTMLElement;
  private readonly value: Text;
  private readonly unit = new Text("unit");
  private readonly spark = new Sparkline();

  constructor(
    private readonly field: string,
    private spec: Spec,
    choose: (() => void) | undefined,
  ) {
    this.value = new Text("num", "span", { "data-value": field });
    const { label, unit, meaning } = spec;
    this.unit.set(unit);
    const parts = [
      el("span", { class: "tile-label" }, label),
      el("span", { class: "tile-value" }, this.value.node, ...(unit ? [this.unit.node] : [])),
      this.spark.node,
    ];
    const title = meaning ? `${field}: ${meaning}` : field;
    const pressed = { class: "tile", title: `${title}. Press to chart it.`, "aria-pressed": "false" };
    this.node = choose ? button("", choose, pressed) : el("div", { class: "tile", title });
    this.node.append(...parts);
  }

  /** Change the format. */
  write(spec: Spec): void {
    this.spec = spec;
    this.unit.set(spec.unit);
  }

  set(value: Parameters<typeof write>[0]): void {
    this.value.set(write(value, this.spec));
    const text = typeof value === "string" || (this.spec.texts !== undefined && value !== 0);
    setAttribute(this.node, "data-text", String(text));
  }

  mark(charted: boolean): void {
    setAttribute(this.node, "aria-pressed", String(charted));
  }

  draw(stream: Stream, now: number): void {
    this.spark.draw(stream.history, stream.columns.get(this.field), now);
  }
}

export class StreamSection {
  readonly node: HTMLElement;
  private readonly facts = new Text("facts");
  private readonly list = el("div", { class: "tiles" });
  private readonly tiles = new Map<string, Tile>();
  private readonly pictures = new Map<string, Thumbnail>();
  private drawn = -1;
  private ros2 = false;

  constructor(
    private readonly stream: Stream,
    private readonly table: FieldTable,
    /** Fields that are shown as gauges. */
    private readonly except: ReadonlySet<string>,
    private readonly choose: (key: string) => void,
  ) {
    this.node = el(
      "section",
      { class: "stream", "aria-label": `Stream ${stream.name}`, "data-stream": stream.name },
      el("header", {}, el("h3", {}, stream.name), this.facts.node),
      this.list,
    );
  }

  /** Show the newest values. */
  values(): void {
    const { stream } = this;
    if (stream.version === this.drawn) return;
    this.drawn = stream.version;
    if (stream.ros2 !== this.ros2) {
      this.ros2 = stream.ros2;
      for (const [field, tile] of this.tiles) tile.write(spec(field, this.table, this.ros2, stream.name));
    }
    this.arrange();
    for (const [field, tile] of this.tiles) tile.set(stream.sample.get(field));
    for (const [field, picture] of this.pictures) picture.set(stream.claims.get(field)?.claim);
  }

  /** Update what changes with time. */
  clock(now: number, charted: ReadonlySet<string>): void {
    const { stream } = this;
    const old = now - stream.takenAt;
    setAttribute(this.node, "data-stale", String(old > STALE_S + stream.silent_s));
    const rate = `${stream.rate(now).toFixed(1)} Hz`;
    this.facts.set(
      `${old > STALE_S ? `${age(old)} old` : rate} · message ${stream.seq} of run ${stream.boot.slice(0, 8)}`,
    );
    for (const [field, tile] of this.tiles) {
      tile.draw(stream, now);
      tile.mark(charted.has(fieldKey(stream.name, field)));
    }
    for (const [field, picture] of this.pictures)
      picture.old(now - (stream.claims.get(field)?.takenAt ?? NaN));
  }

  /** Make a tile for every field of this stream, those of the contract first, in its order. */
  private arrange(): void {
    const ofBytes = claimed(this.stream.sample);
    for (const field of ofBytes) {
      if (this.pictures.has(field)) continue;
      const picture = new Thumbnail(spec(field, this.table).label, field);
      this.pictures.set(field, picture);
      this.list.prepend(picture.node);
    }
    const claims = new Set(ofBytes.flatMap(partsOf));
    const fresh = [...this.stream.sample.keys()].filter(
      (field) => !this.tiles.has(field) && !this.except.has(field) && !claims.has(field),
    );
    if (fresh.length === 0) return;
    for (const field of fresh) {
      const charts = !Number.isNaN(numeric(this.stream.sample.get(field)));
      const choose = charts ? () => this.choose(fieldKey(this.stream.name, field)) : undefined;
      this.tiles.set(field, new Tile(field, spec(field, this.table, this.ros2, this.stream.name), choose));
    }
    const known = Object.keys(this.table.fields);
    const place = (field: string): number => (known.includes(field) ? known.indexOf(field) : known.length);
    const ordered = [...this.tiles].sort(([a], [b]) => place(a) - place(b));
    this.list.append(...ordered.map(([, tile]) => tile.node));
  }
}
