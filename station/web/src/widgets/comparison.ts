// A table of values: at the time under the cursor, and now.

import { power_w, type Value } from "../base/contract";
import { el, Text, table } from "../base/dom";
import { NOTHING, number, type Spec, write } from "../base/format";
import { numeric, type Stream } from "../live/stream";

interface Row {
  readonly spec: Spec;
  readonly past: Text;
  readonly now: Text;
  readonly change: Text;
  value: Value;
}

export class Comparison {
  private readonly body = el("tbody");
  readonly node = el(
    "section",
    { class: "panel compare", "aria-label": "Then and now" },
    table(["Field", "Then", "Now", "Change", "Unit"], this.body),
  );
  private readonly rows = new Map<string, Row>();
  private live: Stream | undefined;

  of(fields: readonly (readonly [string, Spec])[]): void {
    this.rows.clear();
    this.body.replaceChildren();
    for (const [field, spec] of fields) {
      const row = { spec, past: new Text("num"), now: new Text("num"), change: new Text("num"), value: null };
      this.rows.set(field, row);
      this.body.append(
        el(
          "tr",
          { "data-field": field },
          el("th", { scope: "row", title: row.spec.meaning || field }, row.spec.label),
          ...[row.past, row.now, row.change].map(({ node }) => el("td", {}, node)),
          el("td", { class: "unit" }, row.spec.unit),
        ),
      );
    }
  }

  compare(values: ReadonlyMap<string, Value>): void {
    for (const [field, row] of this.rows) {
      row.value = values.get(field) ?? null;
      row.past.set(write(row.value, row.spec));
    }
    this.now(this.live);
  }

  now(stream: Stream | undefined): void {
    this.live = stream;
    for (const [field, row] of this.rows) {
      const value = stream && newest(field, stream);
      row.now.set(write(value, row.spec));
      const change =
        typeof value === "number" && typeof row.value === "number"
          ? (value - row.value) * row.spec.scale
          : NaN;
      row.change.set(
        Number.isNaN(change) || row.spec.texts
          ? NOTHING
          : `${change > 0 ? "+" : ""}${number(change, row.spec.digits)}`,
      );
    }
  }
}

/** The newest value of a field. A car does not send what is derived. */
function newest(field: string, { sample }: Stream): Value | undefined {
  if (field !== "power_w") return sample.get(field);
  const power = power_w(numeric(sample.get("voltage_input")), numeric(sample.get("current_input")));
  return Number.isNaN(power) ? null : power;
}
