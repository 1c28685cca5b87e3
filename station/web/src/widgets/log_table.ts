// A log widget: the rows of its query. It has a request of its own, because Logs Insights takes seconds.

import type { Logs } from "../base/contract";
import { el, Text, table } from "../base/dom";
import { when } from "../base/format";
import { ask, words } from "../server/answers";

// AWS bills a query by the bytes that it reads.
const AGAIN_S = 60;

export class LogTable {
  readonly node: HTMLElement;
  private readonly note = new Text("note", "p", { role: "status" });
  private readonly host = el("div", { class: "log", role: "group", tabindex: "0" });
  private askedAt = -Infinity;
  // A query may take longer than the dashboard's refresh period.
  private asking: AbortController | undefined;

  constructor(
    private readonly parameters: Readonly<Record<string, string>>,
    title: string,
  ) {
    this.host.setAttribute("aria-label", title);
    this.node = el("div", { class: "log-widget" }, this.host, this.note.node);
  }

  /** Ask again, unless the last request is recent; the old rows stay until the answer. */
  async refresh(): Promise<void> {
    const now = performance.now() / 1000;
    if (this.asking || now - this.askedAt < AGAIN_S) return;
    const asking = new AbortController();
    [this.askedAt, this.asking] = [now, asking];
    if (!this.host.hasChildNodes()) this.note.set("Reading the logs …");
    try {
      this.draw(await ask<Logs>("log", this.parameters, asking.signal));
    } catch (error) {
      this.askedAt = -Infinity;
      if (!asking.signal.aborted) this.note.set(words(error));
    } finally {
      this.asking = undefined;
    }
  }

  /** Cancel the request. */
  stop(): void {
    this.asking?.abort();
  }

  private draw({ columns, rows, found, to_s }: Logs): void {
    const until = `until ${when(to_s)}`;
    this.note.set(
      found > rows.length
        ? `the first ${rows.length} of ${found} lines, ${until}`
        : found === 0
          ? `Nothing in this range, ${until}.`
          : until,
    );
    const cells = (row: readonly string[]): HTMLElement[] => row.map((value, i) => cell(columns[i]!, value));
    const body = el("tbody", {}, ...rows.map((row) => el("tr", {}, ...cells(row))));
    const head = columns.map((column) => column.replace(/^@/, ""));
    this.host.replaceChildren(...(rows.length > 0 ? [table(head, body)] : []));
  }
}

function cell(column: string, value: string): HTMLElement {
  if (column === "@timestamp") {
    // "2026-05-04 10:00:00.123", in UTC.
    const at = Date.parse(`${value.replace(" ", "T")}Z`) / 1000;
    return el("td", { class: "num", title: `${value} UTC` }, Number.isNaN(at) ? value : when(at));
  }
  // "123456789012:/aws/lambda/name": the account is the viewer's own.
  if (column === "@log") return el("td", { title: value }, value.replace(/^\d+:/, ""));
  const [head = "", ...details] = value.split("\n");
  if (details.length === 0) return el("td", { class: "words" }, head);
  const folded = el("details", {}, el("summary", {}, head), el("pre", {}, details.join("\n")));
  return el("td", { class: "words" }, folded);
}
