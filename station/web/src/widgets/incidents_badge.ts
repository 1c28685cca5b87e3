// How many incidents a car had in the last day; nothing if it had none.

import { Text } from "../base/dom";

export class IncidentsBadge {
  readonly node: HTMLElement;
  private readonly text = new Text("incidents-badge", "span", { title: "Incidents of the last day" });

  constructor(incidents = 0) {
    this.node = this.text.node;
    this.set(incidents);
  }

  set(incidents: number): void {
    this.text.set(incidents === 0 ? "" : `${incidents} ${incidents === 1 ? "incident" : "incidents"}`);
  }
}
