// A chart for those who do not see it, or use no mouse: a label with its figures, and arrow keys for its cursor.

import type uPlot from "uplot";
import { byId, setAttribute } from "../base/dom";

export interface About {
  readonly title: string;
  /** The names of its lines; one line needs none. */
  readonly lines: readonly string[];
  /** The values with their units. */
  readonly write: (value: number) => string;
  /** The shown range of time. */
  readonly range: () => string;
  /** A time on the chart. */
  readonly at: (seconds: number) => string;
}

// A label is written so often: writing costs a layout.
export const AGAIN_MS = 2_000;
// An arrow key moves the cursor by this part of the chart; with Shift, by a value.
const STEPS = 60;

export class Spoken {
  private writtenAt = -Infinity;

  constructor(
    private readonly host: HTMLElement,
    private readonly plot: uPlot,
    private readonly about: About,
  ) {
    host.setAttribute("role", "img");
    host.tabIndex = 0;
    host.addEventListener("focus", () => this.write());
    host.addEventListener("blur", () => this.leave());
    host.addEventListener("keydown", (event) => this.key(event));
    this.write();
  }

  /** Called with every drawing. */
  refresh(): void {
    if (performance.now() - this.writtenAt >= AGAIN_MS) this.write();
  }

  private write(): void {
    this.writtenAt = performance.now();
    const { title, lines, write, range } = this.about;
    const figures = this.plot.data.slice(1, 1 + Math.max(1, lines.length)).map((column, i) => {
      const { newest, least, most } = extremes(column);
      return Number.isNaN(newest) ? "" : `${lines[i] ? `${lines[i]}: ` : ""}newest ${write(newest)}, minimum ${write(least)}, maximum ${write(most)}`;
    });
    setAttribute(this.host, "aria-label", `Chart ${title}, ${range()}. ${figures.filter(Boolean).join("; ") || "No values"}.`);
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { plot } = this;
    const [times] = plot.data;
    const shown = plot.cursor.left !== undefined && plot.cursor.left >= 0;
    if (event.key === "Escape" && shown) this.leave();
    else {
      const last = times.length - 1;
      const step = event.shiftKey ? 1 : Math.max(1, Math.round(times.length / STEPS));
      const from = (shown ? plot.cursor.idx : undefined) ?? last + step;
      const to = { ArrowLeft: from - step, ArrowRight: from + step, Home: 0, End: last }[event.key];
      if (to === undefined || last < 0) return;
      this.point(Math.min(last, Math.max(0, to)));
    }
    event.preventDefault();
    // The same keys change the car, and leave the view.
    event.stopPropagation();
  }

  private point(index: number): void {
    const { plot, about } = this;
    const at = plot.data[0][index]!;
    plot.setCursor({ left: plot.valToPos(at, "x"), top: 0 });
    const values = plot.data.slice(1, 1 + Math.max(1, about.lines.length)).map((column, i) => {
      const value = column[index];
      return typeof value === "number" && !Number.isNaN(value) ? `${about.lines[i] ?? ""} ${about.write(value)}` : "";
    });
    byId("spoken").textContent = `${about.at(at)}: ${values.filter(Boolean).join(", ") || "no value"}`;
  }

  private leave(): void {
    this.plot.setCursor({ left: -10, top: -10 });
    byId("spoken").textContent = "";
  }
}

export function extremes(column: ArrayLike<number | null | undefined>): { newest: number; least: number; most: number } {
  let [newest, least, most] = [NaN, Infinity, -Infinity];
  for (let i = 0; i < column.length; i += 1) {
    const value = column[i];
    if (typeof value !== "number" || Number.isNaN(value)) continue;
    newest = value;
    if (value < least) least = value;
    if (value > most) most = value;
  }
  return { newest, least, most };
}
