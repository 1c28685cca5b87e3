// The thumbnails of a range's fields of bytes, each of the time under the cursor.

import type { FieldTable, HistoryAnswer } from "../base/contract";
import { el } from "../base/dom";
import { age, spec } from "../base/format";
import { claim, claimed, partsOf } from "../live/attachments";
import { Thumbnail } from "../widgets/thumbnail";

export class Pictures {
  readonly node = el("div", { class: "tiles pictures" });
  /** For each field of bytes its thumbnail, and the rows that have one. */
  private readonly kept = new Map<
    string,
    { readonly picture: Thumbnail; readonly rows: readonly number[] }
  >();

  constructor(private readonly table: FieldTable) {}

  /** Make the thumbnails, and return the names of their fields. */
  set(drive: HistoryAnswer): Set<string> {
    const ofBytes = claimed(new Map(Object.entries(drive.fields)));
    this.kept.clear();
    for (const field of ofBytes) {
      const keys = drive.fields[`${field}.key`]!.mean;
      const rows = [...keys.keys()].filter((row) => keys[row] !== null);
      this.kept.set(field, { picture: new Thumbnail(spec(field, this.table).label, field), rows });
    }
    this.node.replaceChildren(...[...this.kept.values()].map(({ picture }) => picture.node));
    return new Set(ofBytes.flatMap(partsOf));
  }

  /** Show the newest thumbnails of a row; before the first one, the first. */
  point(drive: HistoryAnswer, index: number): void {
    const at = drive.times_s[index]!;
    for (const [field, { picture, rows }] of this.kept) {
      const row = rows.findLast((each) => each <= index) ?? rows[0];
      if (row === undefined) continue;
      picture.set(claim(field, (name) => drive.fields[name]?.mean[row] ?? null));
      const away = drive.times_s[row]! - at;
      picture.when(away > 0 ? `${age(away)} later` : `${age(-away)} before`);
    }
  }
}
