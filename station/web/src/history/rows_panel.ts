// The rows of a stream around the playhead, as a table: to sort, and to copy as CSV.

import type { Value } from "../base/contract";
import { button, el, panel, setAttribute, Text } from "../base/dom";
import { dayTime, number, type Spec, write, zone } from "../base/format";
import { lastAt, type Range } from "../base/range";
import { speak, stepped } from "../charts/spoken";
import type { Panel, Touch } from "./panels";
import type { Past } from "./past";

const TABLE = "table";
// Rows that are in the page at a time: around the playhead, or the first in the order of a column.
const SHOWN = 100;
// Rows that fly by cannot be read: they are written so often.
const AGAIN_MS = 100;

export const rowsKey = (stream: string): string => `${TABLE}:${stream}`;
export const rowsStream = (key: string): string | undefined =>
  key.startsWith(`${TABLE}:`) ? key.slice(TABLE.length + 1) || undefined : undefined;

interface Column {
  readonly name: string;
  readonly spec: Spec;
  readonly values: readonly Value[];
}

export class RowsPanel implements Panel<Past> {
  readonly title: string;
  readonly node: HTMLElement;
  private readonly note = new Text("note");
  private readonly said = new Text("note", "span", { role: "status" });
  private readonly head = el("tr");
  private readonly body = el("tbody");
  private readonly box = el(
    "div",
    { class: "rows", tabindex: "0", role: "region" },
    el("table", {}, el("thead", {}, this.head), this.body),
  );
  private times: readonly number[] = [];
  private columns: readonly Column[] = [];
  private range: Range = [0, 1];
  /** The rows of the range, in their order, and the first of those that are in the page. */
  private order: number[] = [];
  private from = 0;
  /** The lines of the table, which are written again for other rows. */
  private lines: { readonly node: HTMLElement; readonly cells: readonly Text[] }[] = [];
  private lit: HTMLElement | undefined;
  private filling: number | undefined;
  private sort: { readonly column: string; readonly down: boolean } = { column: "", down: false };
  private index = -1;
  private keyed = false;

  constructor(
    private readonly stream: string,
    private readonly touch: Touch,
  ) {
    this.title = `Table of ${stream}`;
    const copy = button("Copy CSV", () => void this.copy(), { title: "Copy the rows of the range as CSV" });
    setAttribute(this.box, "aria-label", `Rows of ${stream}`);
    this.node = panel(this.title, "rows-panel", [this.note.node, this.said.node, copy], this.box);
    this.body.addEventListener("click", ({ target }) => {
      const line = this.lines.findIndex(({ node }) => node.contains(target as Element));
      if (line < 0) return;
      touch.point(this.times[this.order[this.from + line]!]!);
      touch.pick();
    });
    this.box.addEventListener("keydown", (event) => this.key(event));
    this.box.addEventListener("blur", () => {
      if (this.keyed) touch.pick();
      this.keyed = false;
    });
  }

  set(past: Past, range: Range): boolean {
    const drive = past.drives.get(this.stream);
    if (!drive || drive.times_s.length === 0) return false;
    this.times = drive.times_s;
    this.columns = past.shown(this.stream).map((name) => {
      const key = past.key(this.stream, name);
      return { name, spec: past.spec(key), values: drive.fields[name]!.mean };
    });
    this.index = -1;
    this.range = range;
    this.lines = [];
    this.heading();
    this.arrange();
    this.fill(0);
    return true;
  }

  move(range: Range): void {
    this.range = range;
    this.fillSoon();
  }

  point(at: number): void {
    this.index = this.times.length > 0 ? lastAt(this.times, at) : -1;
    const place = this.order.indexOf(this.index);
    // In the order of time the rows go along with the playhead.
    const outside = place < this.from || place >= this.from + SHOWN;
    if (place >= 0 && outside && !this.sort.column) this.fillSoon();
    this.light();
  }

  destroy(): void {
    window.clearTimeout(this.filling);
    this.node.remove();
  }

  /** Put the rows of the range into their order. */
  private arrange(): void {
    const inside = (at: number): boolean => this.range[0] <= at && at <= this.range[1];
    this.order = [...this.times.keys()].filter((row) => inside(this.times[row]!));
    const column = this.columns.find(({ name }) => name === this.sort.column);
    const sign = this.sort.down ? -1 : 1;
    if (column)
      this.order.sort(
        (a, b) => sign * compared(column.values[a] ?? null, column.values[b] ?? null, sign) || a - b,
      );
    else if (this.sort.down) this.order.reverse();
    const shown = Math.min(SHOWN, this.order.length);
    this.note.set(
      shown < this.order.length ? `${shown} of ${number(this.order.length)} rows` : `${shown} rows`,
    );
  }

  private fillSoon(): void {
    this.filling ??= window.setTimeout(() => {
      this.filling = undefined;
      this.arrange();
      this.fill(this.sort.column ? 0 : this.order.indexOf(this.index) - SHOWN / 2);
    }, AGAIN_MS);
  }

  private fill(first: number): void {
    this.from = Math.max(0, Math.min(first, this.order.length - SHOWN));
    const rows = this.order.slice(this.from, this.from + SHOWN);
    while (this.lines.length < rows.length) this.lines.push(this.line());
    rows.forEach((row, i) => {
      const [time, ...cells] = this.lines[i]!.cells;
      time!.set(dayTime(this.times[row]!, { fractionalSecondDigits: 3 }));
      this.columns.forEach(({ values, spec }, c) => cells[c]!.set(write(values[row], spec)));
    });
    const nodes = this.lines.slice(0, rows.length).map(({ node }) => node);
    if (nodes.length !== this.body.childElementCount || nodes[0] !== this.body.firstElementChild)
      this.body.replaceChildren(...nodes);
    this.light();
  }

  private line(): (typeof this.lines)[number] {
    const time = new Text("num", "th", { scope: "row" });
    const cells = [time, ...this.columns.map(() => new Text("num", "td"))];
    return { node: el("tr", {}, ...cells.map(({ node }) => node)), cells };
  }

  /** Show where the playhead is. */
  private light(): void {
    const line = this.lines[this.order.indexOf(this.index) - this.from]?.node;
    const lit = line?.isConnected ? line : undefined;
    if (lit !== this.lit) this.lit?.removeAttribute("aria-current");
    this.lit = lit;
    lit?.setAttribute("aria-current", "true");
    // It reads the layout, so once all panels have moved.
    if (lit) queueMicrotask(() => this.reveal(lit));
  }

  /** Scroll to a line; the page itself does not move for it. */
  private reveal({ offsetTop: top, offsetHeight: height }: HTMLElement): void {
    const { box } = this;
    const head = this.head.offsetHeight;
    if (top - head < box.scrollTop || top + height > box.scrollTop + box.clientHeight)
      box.scrollTop = top - box.clientHeight / 2;
  }

  private heading(): void {
    const cell = (name: string, label: string, unit: string): HTMLElement => {
      const { column, down } = this.sort;
      const sorted = column === name ? (down ? "descending" : "ascending") : "none";
      const sort = button(unit ? `${label}, ${unit}` : label, () => this.by(name), { class: "sort" });
      return el("th", { scope: "col", "aria-sort": sorted }, sort);
    };
    this.head.replaceChildren(
      cell("", "Time", zone(this.times[0]!)),
      ...this.columns.map(({ name, spec }) => cell(name, spec.label, spec.unit)),
    );
  }

  private by(column: string): void {
    this.sort = { column, down: this.sort.column === column && !this.sort.down };
    const focused = [...this.head.children].findIndex((each) => each.contains(document.activeElement));
    this.heading();
    (this.head.children[focused]?.firstElementChild as HTMLElement | null)?.focus();
    this.arrange();
    this.fill(0);
    this.box.scrollTop = 0;
  }

  private key(event: KeyboardEvent): void {
    const keys: Readonly<Record<string, string>> = { ArrowUp: "ArrowLeft", ArrowDown: "ArrowRight" };
    const { shiftKey } = event;
    const place = Math.max(0, this.order.indexOf(this.index));
    const to =
      event.target === this.box
        ? stepped({ key: keys[event.key] ?? event.key, shiftKey }, place, 0, this.order.length - 1)
        : undefined;
    if (to === undefined) return;
    const row = this.order[to]!;
    [this.keyed, this.index] = [true, row];
    if (this.sort.column && (to < this.from || to >= this.from + SHOWN)) this.fill(to - SHOWN / 2);
    this.touch.point(this.times[row]!);
    const values = this.columns.map(({ spec, values }) =>
      `${spec.label} ${write(values[row], spec)} ${spec.unit}`.trim(),
    );
    speak(`${dayTime(this.times[row]!, { fractionalSecondDigits: 1 })}: ${values.join(", ")}`);
    event.preventDefault();
    event.stopPropagation();
  }

  /** Copy all rows of the range, in their order, in the units that are shown. */
  private async copy(): Promise<void> {
    const quoted = (text: string): string =>
      /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    const head = [
      "time",
      ...this.columns.map(({ name, spec }) => (spec.unit ? `${name} (${spec.unit})` : name)),
    ];
    const rows = this.order.map((row) => [
      iso(this.times[row]!),
      ...this.columns.map(({ values, spec }) => plain(values[row] ?? null, spec)),
    ]);
    const text = [head, ...rows].map((cells) => cells.map(quoted).join(",")).join("\n");
    try {
      await navigator.clipboard.writeText(`${text}\n`);
      this.said.set(`Copied ${number(rows.length)} rows.`);
    } catch {
      // Without HTTPS on another computer, or without the right, a browser gives no clipboard.
      this.said.set("This browser does not let the page copy: Download saves the range as CSV.");
    }
  }
}

/** A time as a file has it, to the microsecond. */
function iso(at: number): string {
  const us = Math.round(at * 1e6);
  const second = new Date(Math.floor(us / 1e6) * 1000).toISOString().slice(0, 19);
  return `${second}.${String(us % 1e6).padStart(6, "0")}Z`;
}

/** A value as a file has it: a plain number in the unit that is shown, or a text. */
function plain(value: Value, { scale, shift }: Spec): string {
  if (value === null) return "";
  return typeof value === "number"
    ? String(Number((value * scale + shift).toPrecision(12)))
    : harmless(String(value));
}

/** A robot's text that is no formula where it is pasted: as in the server's files, by OWASP. */
export const harmless = (text: string): string => (/^\s*[=+\-@＝＋－＠]/.test(text) ? `'${text}` : text);

/** Numbers before texts, and what is missing last, whatever the `sign` of the order. */
function compared(one: Value, other: Value, sign: number): number {
  if (one === null || other === null) return sign * (Number(one === null) - Number(other === null));
  if (typeof one === "number" && typeof other === "number") return one - other;
  return String(one).localeCompare(String(other), "en", { numeric: true });
}
