// A chart among the panels, what its lines are made of, and the list that chooses a field.

import { choices, el } from "../base/dom";
import type { Spec } from "../base/format";
import { lastAt, type Range } from "../base/range";
import { type Lines, LinesPanel } from "../charts/lines_panel";
import type { Mark, Threshold } from "../charts/range_chart";
import type { Panel, Touch } from "./panels";

export interface ChartOptions<D> {
  readonly title: string;
  readonly lines: (data: D) => Lines | undefined;
  readonly touch: Touch;
  /** The name of a single line's value, for tests. */
  readonly reading?: string;
}

export class Chart<D> implements Panel<D> {
  readonly title: string;
  readonly panel: LinesPanel;
  private x: readonly number[] = [];

  constructor(private readonly options: ChartOptions<D>) {
    const { title, touch, reading } = options;
    this.title = title;
    this.panel = new LinesPanel({
      title,
      ...(reading === undefined ? {} : { reading }),
      hands: touch,
      onCursor: (index) => touch.point(index === null ? null : (this.x[index] ?? null)),
    });
  }

  get node(): HTMLElement {
    return this.panel.node;
  }

  set(data: D, range: Range): boolean {
    const lines = this.options.lines(data);
    if (!lines) return false;
    this.x = lines.x;
    this.panel.draw(lines, range);
    return true;
  }

  move(range: Range): void {
    this.panel.move(range);
  }

  point(at: number): void {
    if (this.x.length > 0) this.panel.point(lastAt(this.x, at));
  }

  mark(marks: readonly Mark[]): void {
    this.panel.mark(marks);
  }

  limit(threshold: Threshold | undefined): void {
    this.panel.limit(threshold);
  }

  destroy(): void {
    this.panel.destroy();
  }
}

/** Columns of several streams on one axis: each has a row of its own where another has none. */
export function together(
  fields: readonly { readonly x: readonly number[]; readonly y: readonly (number | null)[] }[],
): Pick<Lines, "x" | "columns"> {
  const [first] = fields;
  if (fields.every(({ x }) => x === first!.x)) return { x: first!.x, columns: fields.map(({ y }) => y) };
  const x = [...new Set(fields.flatMap((field) => [...field.x]))].sort((a, b) => a - b);
  const row = new Map(x.map((at, i) => [at, i]));
  const columns = fields.map((field) => {
    const column = new Array<number | null | undefined>(x.length).fill(undefined);
    field.x.forEach((at, i) => {
      column[row.get(at)!] = field.y[i] ?? null;
    });
    return column;
  });
  return { x, columns };
}

/** How a line of a spec is written: the columns are as they are shown. */
export const lineOf = ({ unit, digits, texts, time }: Spec, label: string): Lines["lines"][number] => ({
  ...{ label, unit, digits },
  ...(texts ? { texts } : {}),
  ...(time ? { time } : {}),
});

/** A list of fields that toggles one, such as the lines of a chart: made when it is needed. */
export function fieldList(
  label: string,
  sign: string,
  groups: () => ReadonlyMap<string, readonly (readonly [key: string, label: string])[]>,
  chosen: (key: string) => void,
): HTMLSelectElement {
  const list = el("select", { class: "pick", "aria-label": label, title: label });
  const first = el("option", { value: "", selected: "", disabled: "", hidden: "" }, sign);
  const offer = (): void => {
    const all = [...groups()].filter(([, of]) => of.length > 0);
    list.replaceChildren(first, ...all.map(([name, of]) => el("optgroup", { label: name }, ...choices(of))));
    first.selected = true;
  };
  list.append(first);
  for (const event of ["pointerdown", "focus"]) list.addEventListener(event, offer);
  list.addEventListener("input", () => {
    const { value } = list;
    first.selected = true;
    chosen(value);
  });
  return list;
}
