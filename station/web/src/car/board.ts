// A car's charts, which the viewer chooses and arranges.

import type { FieldTable, TrackMap } from "../base/contract";
import type { Linear } from "../base/format";
import { WINDOWS } from "../charts/windows";
import type { Robot } from "../live/robot";
import { Arranged } from "../widgets/arranged";
import { type BoardPanel, panelOf } from "./board_panels";
import { BOARD } from "./car_charts";

const MOST = 24;

export class Board extends Arranged<BoardPanel> {
  private window_s: number = WINDOWS[0];

  constructor(table: FieldTable, track: TrackMap | null, changed: () => void) {
    const make = (key: string): BoardPanel | undefined => {
      const panel = panelOf(key, table, track);
      panel?.span(this.window_s);
      return panel;
    };
    super(make, MOST, changed);
    this.set([...BOARD.keys()]);
  }

  span(window_s: number): void {
    this.window_s = window_s;
    for (const panel of this.panels.values()) panel.span(window_s);
  }

  values(robot: Robot, speed: Linear | undefined): void {
    for (const panel of this.panels.values()) panel.node.hidden = !panel.values(robot, speed);
  }

  draw(now: number): void {
    const panels = [...this.panels.values()].filter(({ node }) => !node.hidden);
    // All in the same frame: a frame costs more than its charts.
    if (panels.some((panel) => panel.due(now))) for (const panel of panels) panel.draw(now);
  }
}
