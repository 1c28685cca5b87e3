// What the page has for every view, and what a view is to the page. main.ts lists the views.

import type { Config, FieldTable } from "../base/contract";
import { el } from "../base/dom";
import type { Route } from "../base/route";
import type { DrivePanel } from "../drive/panel";
import type { StopControl } from "../drive/stop_control";
import type { Looks } from "../link/viewing";
import type { Alarms } from "../live/alarms";
import type { Fleet } from "../live/fleet";
import type { Registry } from "../live/registry";
import type { PicturePanel } from "../video/panel";
import type { Speed } from "../widgets/status_bar";

/** What the page has for its views. */
export interface Services {
  readonly config: Config;
  readonly table: FieldTable;
  readonly fleet: Fleet;
  readonly registry: Registry;
  readonly alarms: Alarms;
  readonly stops: StopControl;
  readonly drive: DrivePanel;
  readonly picture: PicturePanel;
  /** The view has other contents: the page arranges it again. */
  readonly changed: () => void;
}

/** A view. What one does not have, it does not need. */
export interface View<R extends Route = Route> {
  readonly node: HTMLElement;
  /** The title of the browser's tab. */
  title(route: R): string;
  /** Show what an address says. */
  show(route: R): void;
  /** Another view is shown: stop what costs. */
  leave?(): void;
  /** There is a new car or stream, or the view itself asked for it. */
  arrange?(): void;
  /** Whether there is nothing to see before a car is heard. */
  waits?(): boolean;
  /** The cars that the viewer sees, and how closely. */
  looks?(): Looks;
  /** Called at most 25 times a second, with the page's time in seconds. */
  values?(now: number): void;
  speed?(now: number): Speed | undefined;
  /** Called four times a second; `linked` while live messages can come. */
  clock?(now: number, linked: boolean): void;
  key?(event: KeyboardEvent): void;
}

/** A view's node, with its name and what stands beside that. */
export const viewNode = (
  name: string,
  title: Node | string,
  beside: readonly (Node | string)[],
  ...children: (Node | string)[]
): HTMLElement => {
  const heading = typeof title === "string" ? el("h2", { class: "car-name" }, title) : title;
  return el("article", { class: name }, el("header", { class: "car-head" }, heading, ...beside), ...children);
};
