// The faults since this page was opened, the newest first.

import { el, panel, setAttribute, Text, table } from "../base/dom";
import { age, clockTime, zone } from "../base/format";
import type { Fault, Robot } from "../live/robot";

const SHOWN = 6;

interface Row {
  readonly node: HTMLElement;
  readonly cells: readonly Text[];
}

/** A fixed number of rows, so that a new fault moves nothing else on the page. */
export class FaultLog {
  readonly node: HTMLElement;
  private readonly note = new Text("note", "p");
  private readonly rows: readonly Row[];

  constructor() {
    this.rows = Array.from({ length: SHOWN }, () => {
      const cells = ["fault-at", "fault-name", "fault-for"].map((name) => new Text(name, "td"));
      return { node: el("tr", {}, ...cells.map(({ node }) => node)), cells };
    });
    const head = [`Since, ${zone(Date.now() / 1000)}`, "Fault", "For"];
    const body = el("tbody", {}, ...this.rows.map(({ node }) => node));
    this.node = panel("Fault log", "faults", [this.note.node], table(head, body));
  }

  refresh(robot: Robot): void {
    const newest = robot.faults.slice(-SHOWN).reverse();
    const count = robot.faults.length;
    this.note.set(
      count === 0
        ? "none since this page was opened"
        : count > SHOWN
          ? `the newest ${SHOWN} of ${count}`
          : "since this page was opened",
    );
    this.rows.forEach(({ node, cells }, i) => {
      const fault: Fault | undefined = newest[i];
      setAttribute(node, "data-state", fault ? (fault.over ? "over" : "on") : "none");
      cells[0]!.set(fault ? clockTime(fault.since) : "");
      cells[1]!.set(fault?.name ?? "");
      cells[2]!.set(fault ? `${age(fault.until - fault.since)}${fault.over ? "" : ", on"}` : "");
    });
  }
}
