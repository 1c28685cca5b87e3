// A chart for those who do not see it, or use no mouse: a label with its figures, and arrow keys for its cursor.

import type uPlot from "uplot";
import { byId, setAttribute } from "../base/dom";

export interface About {
  readonly title: string;
  /** The names of its lines; one line needs none. */
  readonly lines: readonly string[];
  /** A value of a line, by its place among them, with its unit. */
  readonly write: (value: number, line: number) => string;
  /** The shown range. */
  readonly range: () => string;
  /** A place on the x axis. */
  readonly at: (x: number) => string;
  /** The x axis is another quantity than time. */
  readonly timeless?: boolean;
  /** Columns two and three are the minimum and the maximum of the line. */
  readonly band?: boolean;
  /** A key has moved the cursor to a row; null if it has taken it away. */
  readonly keyed?: (index: number | null) => void;
  /** The cursor rests where a key has moved it: the chart has lost the focus. Without this, the cursor goes then. */
  readonly rested?: () => void;
}

// A label is written so often: writing costs a layout.
export const AGAIN_MS = 2_000;
// A range that is panned changes with every frame.
const SETTLED_MS = 300;
// An arrow key moves the cursor by a value; with Shift, by this part of the chart.
const STEPS = 20;

/** The row to which a key moves a cursor among the rows that are shown: undefined for another key. */
export function stepped(
  { key, shiftKey }: Pick<KeyboardEvent, "key" | "shiftKey">,
  from: number,
  first: number,
  last: number,
): number | undefined {
  const step = shiftKey ? Math.max(1, Math.round((last - first) / STEPS)) : 1;
  const to = { ArrowLeft: from - step, ArrowRight: from + step, Home: first, End: last }[key];
  return to === undefined || last < first ? undefined : Math.min(last, Math.max(first, to));
}

/** Whether the key is one of the browser's own. */
export const chorded = ({ ctrlKey, metaKey, altKey }: KeyboardEvent): boolean => ctrlKey || metaKey || altKey;

/** Tell whoever cannot see it where a cursor is. */
export function speak(text: string): void {
  byId("spoken").textContent = text;
}

export class Spoken {
  private writtenAt = -Infinity;
  private writing: number | undefined;
  /** A key has moved the cursor. */
  private moved = false;

  constructor(
    private readonly host: HTMLElement,
    private readonly plot: uPlot,
    private readonly about: About,
  ) {
    host.setAttribute("role", "img");
    host.tabIndex = 0;
    host.addEventListener("focus", () => this.write());
    host.addEventListener("blur", () => this.blurred());
    host.addEventListener("keydown", (event) => this.key(event));
    this.write();
  }

  /** Called with every drawing. */
  refresh(): void {
    if (performance.now() - this.writtenAt >= AGAIN_MS) this.write();
  }

  /** Called after a change of what is shown; several in a row are one. */
  changed(): void {
    window.clearTimeout(this.writing);
    this.writing = window.setTimeout(() => this.write(), SETTLED_MS);
  }

  private write(): void {
    this.writtenAt = performance.now();
    const { title, write, range, timeless, band } = this.about;
    const { data } = this.plot;
    const [first, last] = this.visible();
    const within = (column: number): Extremes => extremes(data[column]!, first, last + 1);
    const figures = this.lines().map((name, i) => {
      const { newest } = within(i + 1);
      const [least, most] = [within(band ? 2 : i + 1).least, within(band ? 3 : i + 1).most];
      return Number.isNaN(newest)
        ? ""
        : `${name ? `${name}: ` : ""}${timeless ? "last" : "newest"} ${write(newest, i)}, minimum ${write(least, i)}, maximum ${write(most, i)}`;
    });
    setAttribute(
      this.host,
      "aria-label",
      `Chart ${title}, ${range()}. ${figures.filter(Boolean).join("; ") || "No values"}.`,
    );
  }

  private lines(): readonly string[] {
    return this.about.lines.length > 1 ? this.about.lines : [""];
  }

  /** The first and the last index on the screen; none is -1 and before the first. */
  private visible(): readonly [number, number] {
    const { data, scales } = this.plot;
    const { min, max } = scales.x ?? {};
    const times = Array.from(data[0]);
    const last = times.findLastIndex((x) => x <= (max ?? Infinity));
    return [times.findIndex((x) => x >= (min ?? -Infinity)), last];
  }

  private key(event: KeyboardEvent): void {
    if (chorded(event)) return;
    const { plot } = this;
    const shown = plot.cursor.left !== undefined && plot.cursor.left >= 0;
    if (event.key === "Escape" && shown) {
      this.leave();
      this.moved = false;
      this.about.keyed?.(null);
    } else {
      const [first, last] = this.visible();
      const from = (shown ? plot.cursor.idx : undefined) ?? last + 1;
      const to = first < 0 ? undefined : stepped(event, from, first, last);
      if (to === undefined) return;
      this.point(to);
    }
    event.preventDefault();
    // The same keys change the car, and leave the view.
    event.stopPropagation();
  }

  private point(index: number): void {
    const { plot, about } = this;
    const x = plot.data[0][index]!;
    plot.setCursor({ left: plot.valToPos(x, "x"), top: 0 });
    const values = this.lines().map((name, i) => {
      const value = valueAt(plot.data[i + 1] ?? [], index);
      return typeof value === "number" && !Number.isNaN(value)
        ? `${name} ${about.write(value, i)}`.trim()
        : "";
    });
    speak(`${about.at(x)}: ${values.filter(Boolean).join(", ") || "no value"}`);
    this.moved = true;
    about.keyed?.(index);
  }

  private blurred(): void {
    const { rested } = this.about;
    if (!rested) this.leave();
    else if (this.moved) {
      speak("");
      rested();
    }
    this.moved = false;
  }

  private leave(): void {
    this.plot.setCursor({ left: -10, top: -10 });
    speak("");
  }
}

/** The value of a row; of a row of another line, the one before it. */
export function valueAt<T>(column: ArrayLike<T>, index: number): T | undefined {
  while (index > 0 && column[index] === undefined) index -= 1;
  return column[index];
}

interface Extremes {
  readonly newest: number;
  readonly least: number;
  readonly most: number;
}

export function extremes(
  column: ArrayLike<number | null | undefined>,
  from = 0,
  to = column.length,
): Extremes {
  let [newest, least, most] = [NaN, Infinity, -Infinity];
  for (let i = Math.max(0, from); i < to; i += 1) {
    const value = column[i];
    if (typeof value !== "number" || Number.isNaN(value)) continue;
    newest = value;
    if (value < least) least = value;
    if (value > most) most = value;
  }
  return { newest, least, most };
}
