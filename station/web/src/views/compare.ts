// Several runs, laps or robots over one axis: the time since each began, or the distance since then.

import type { Config, FieldTable } from "../base/contract";
import { el } from "../base/dom";
import type { Query } from "../base/route";
import type { Fleet } from "../live/fleet";

export class CompareView {
  readonly node = el("article", { class: "compare-view" });

  constructor(
    private readonly config: Config,
    private readonly table: FieldTable,
    private readonly fleet: Fleet,
  ) {}

  show(query: Query<"compare"> | undefined): void {
    void [query, this.config, this.table, this.fleet];
  }
}
