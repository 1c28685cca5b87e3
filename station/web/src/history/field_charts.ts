// A chart for each chosen field of a range, with a line for each part. All charts share their range and their cursor.

import { button, el, setAttribute } from "../base/dom";
import { AS_SENT, number, type Spec, write } from "../base/format";
import type { Range } from "../base/range";
import { type Columns, dash, hue, LinesPanel } from "../charts/lines_panel";
import type { Hands, Mark } from "../charts/range_chart";
import { extremes } from "../charts/spoken";

export interface FieldChartsOptions {
  readonly spec: (field: string) => Spec;
  readonly hands: Hands;
  /** The cursor is on another row; null if it has left the charts. */
  readonly onCursor: (index: number | null) => void;
  /** The viewer has chosen other fields. */
  readonly onFields: () => void;
  /** The charts' name: those with the same share their cursor. */
  readonly sync: string;
  /** What is charted unless the viewer chooses. */
  readonly usual: readonly string[];
  readonly most: number;
}

/** What is charted, in the units that are shown. */
export interface Charted {
  readonly x: readonly number[];
  /** The unit of x; without it x is a time. */
  readonly unit?: string;
  /** A line has a gap after this much of x without a value. */
  readonly hole: number;
  /** For each field a column for each name; of a single name, its minimum and maximum may follow. */
  readonly fields: ReadonlyMap<string, Columns>;
  readonly names: readonly string[];
}

const FIRST_CHARTS = 6;

export class FieldCharts {
  readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Fields to chart" });
  readonly node = el("div", { class: "charts" });
  private readonly panels = new Map<string, { readonly panel: LinesPanel; readonly kind: string }>();
  private data: Charted = { x: [], hole: 1, fields: new Map(), names: [] };
  private range: Range = [0, 1];
  private marks: readonly Mark[] = [];

  constructor(private readonly options: FieldChartsOptions) {}

  /** The charted fields. */
  get fields(): string[] {
    return [...this.panels.keys()];
  }

  /** Chart the fields that are `wanted`; without one of them, the usual ones. */
  set(data: Charted, range: Range, wanted: readonly string[]): void {
    [this.data, this.range] = [data, range];
    const all = [...data.fields.keys()];
    const known = [wanted, this.options.usual]
      .map((fields) => fields.filter((field) => all.includes(field)))
      .find((fields) => fields.length > 0);
    const chosen = (known ?? all.slice(0, FIRST_CHARTS)).slice(0, this.options.most);
    for (const field of this.fields) if (!chosen.includes(field)) this.remove(field);
    for (const field of chosen) this.update(field);
    this.chips.replaceChildren(...all.map((field) => this.chip(field)));
  }

  clear(): void {
    for (const field of this.fields) this.remove(field);
    this.chips.replaceChildren();
  }

  move(range: Range): void {
    this.range = range;
    for (const { panel } of this.panels.values()) panel.chart.move(range);
  }

  /** Mark times on every chart. */
  mark(marks: readonly Mark[]): void {
    this.marks = marks;
    for (const { panel } of this.panels.values()) panel.chart.mark(marks);
  }

  point(index: number): void {
    for (const { panel } of this.panels.values()) panel.chart.point(index);
  }

  /** Show the values of a row in the charts' headings. */
  read(index: number): void {
    for (const [field, { panel }] of this.panels) {
      const spec = { ...this.options.spec(field), ...AS_SENT };
      panel.read(this.data.names.map((_, i) => write(this.data.fields.get(field)?.[i]?.[index], spec)));
    }
  }

  private chip(field: string): HTMLElement {
    const charted = (): string => String(this.panels.has(field));
    const chip = button(
      this.options.spec(field).label,
      () => {
        if (this.panels.has(field)) this.remove(field);
        else if (this.panels.size < this.options.most) this.update(field);
        setAttribute(chip, "aria-pressed", charted());
        this.options.onFields();
      },
      { class: "chip", title: field, "aria-pressed": charted() },
    );
    return chip;
  }

  private remove(field: string): void {
    this.panels.get(field)?.panel.destroy();
    this.panels.delete(field);
  }

  /** Draw a field anew, in the chart that it has if its lines are the same. */
  private update(field: string): void {
    const { x, hole, unit: along, fields, names } = this.data;
    const columns = fields.get(field)!;
    const { label, unit, digits } = this.options.spec(field);
    const band = columns.length > names.length;
    const kind = JSON.stringify([names, band, along, unit]);
    const known = this.panels.get(field);
    let panel = known?.panel;
    if (panel && known?.kind === kind) panel.set(x, columns, this.range, hole);
    else {
      const { sync, hands, onCursor } = this.options;
      const single = names.length === 1;
      const curves = names.map((name, i) => ({
        label: single ? label : name,
        colour: single ? "--accent" : `--${hue(i)}`,
        dash: dash(i),
      }));
      const fresh = new LinesPanel(
        {
          ...{ title: label, unit, digits, along, curves, sync, hole_s: hole, band, hands, onCursor },
          reading: single ? field : undefined,
        },
        x,
        columns,
        this.range,
      );
      if (panel) panel.node.before(fresh.node);
      else this.node.append(fresh.node);
      panel?.destroy();
      panel = fresh;
      panel.chart.mark(this.marks);
      this.panels.set(field, { panel, kind });
    }
    if (names.length > 1) return;
    const [low, high] = [extremes(columns[band ? 1 : 0]!).least, extremes(columns[band ? 2 : 0]!).most];
    panel.note.set(low > high ? "" : `${number(low, digits)} to ${number(high, digits)}`);
  }
}
