// The laps of a range, which are looked for when the list is opened: each shows its time alone, in every panel.

import type { Lap, LapsAnswer } from "../base/contract";
import { button, el, setAttribute, Text } from "../base/dom";
import { capital, number } from "../base/format";
import { inUs, type Range, rangeOf, same } from "../base/range";
import { ask, Latest } from "../server/answers";

export const lapLabel = ({ lap, time_s, best }: Lap): string =>
  `${lap}: ${number(time_s, 2)} s${best ? ", the best" : ""}`;

export interface LapsListEvents {
  /** The robot and the range in which laps are looked for. */
  readonly asked: () => readonly [robot: string, range: Range];
  readonly zoom: (to: Range) => void;
  readonly out: () => void;
}

export class LapsList {
  readonly node = el("details", { class: "panel laps" });
  private readonly chips = el("div", { class: "chips", role: "group", "aria-label": "Laps" });
  private readonly note = new Text("note", "p", { role: "status" });
  private readonly loading = new Latest();
  private laps: readonly (readonly [Range, HTMLElement])[] = [];
  private found = "";
  private range: Range = [0, 1];

  constructor(private readonly events: LapsListEvents) {
    this.node.append(el("summary", {}, "Laps"), this.chips, this.note.node);
    this.node.addEventListener("toggle", () => void this.find());
  }

  /** Another range is shown: of the same laps, one of them, or of other ones. */
  show(range: Range): void {
    this.range = range;
    for (const [lap, chip] of this.laps) setAttribute(chip, "aria-pressed", String(same(lap, range)));
    void this.find();
  }

  private async find(): Promise<void> {
    const [robot, range] = this.events.asked();
    const asked = { robot, ...inUs(range) };
    const key = JSON.stringify(asked);
    if (!this.node.open || key === this.found) return;
    this.found = key;
    this.laps = [];
    this.chips.replaceChildren();
    this.note.set("Looking for laps …");
    await this.loading.run(
      async (signal) => {
        const { laps, reason } = await ask<LapsAnswer>("laps", asked, signal);
        this.laps = laps.map((lap) => {
          const range = rangeOf(lap);
          const chip = button(
            lapLabel(lap),
            () => (same(range, this.range) ? this.events.out() : this.events.zoom(range)),
            { class: "chip", "aria-pressed": String(same(range, this.range)) },
          );
          return [range, chip] as const;
        });
        this.chips.replaceChildren(...this.laps.map(([, chip]) => chip));
        this.note.set(laps.length === 0 ? `${capital(reason)}.` : "");
      },
      (reason) => {
        this.found = "";
        this.note.set(reason);
      },
    );
  }
}
