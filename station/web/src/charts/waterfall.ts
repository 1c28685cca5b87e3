// The delay by hop: a bar for each hop of a message, which begins at the end of the one before.

import type { Config } from "../base/contract";
import { el, panel, setAttribute, Text } from "../base/dom";
import { milliseconds, NOTHING } from "../base/format";
import { MEDIAN_S } from "../live/bounds";
import { type Delay, LEGS, type Leg, type Robot } from "../live/robot";

const NAMES: Readonly<Record<Leg | "screen", readonly [string, string]>> = {
  car: ["Car", "from the sample to its leaving the car"],
  toCloud: ["Broker and rule", "from the car to the topic rule, over the broker"],
  toLambda: ["Lambda", "from the rule to the function"],
  toPubNub: ["PubNub takes it", "from the function to PubNub"],
  toPage: ["Page hears it", "from PubNub to this page"],
  screen: ["Page shows it", "from its arrival to the next picture"],
};
const SHOWN: Readonly<Record<Config["live"], readonly (Leg | "screen")[]>> = {
  pubnub: [...LEGS, "screen"],
  iot: ["car", "toPage", "screen"],
};
const STRAIGHT = ["Network and broker", "from the car over AWS IoT to this page"] as const;
// A smaller clock offset is normal for clocks that are not measured.
const CLOCKS_MS = 5;

export class Waterfall {
  readonly node: HTMLElement;
  private readonly median = new Text("num", "span", { "data-value": "delay_median" });
  private readonly warning = new Text("warning", "p");
  private readonly shown: (typeof SHOWN)[Config["live"]];
  private readonly rows = new Map<Leg | "screen", { readonly bar: HTMLElement; readonly text: Text }>();

  constructor({ live }: Config) {
    this.shown = SHOWN[live];
    const list = el("dl", { class: "falls" });
    for (const leg of this.shown) {
      const [name, meaning] = live === "iot" && leg === "toPage" ? STRAIGHT : NAMES[leg];
      const bar = el("span", { class: "fall-bar" });
      const text = new Text("num", "span", { "data-value": `leg_${leg}` });
      this.rows.set(leg, { bar, text });
      list.append(
        el("dt", { title: meaning }, name),
        el("dd", { class: "fall-track", "aria-hidden": "true" }, bar),
        el("dd", { class: "fall-ms" }, text.node, el("span", { class: "unit" }, "ms")),
      );
    }
    const title = "from leaving the car to arriving at the page, which then has to draw it";
    const whole = el(
      "p",
      { class: "reading" },
      el("span", { class: "label", title }, "car to page"),
      this.median.node,
      el("span", { class: "unit" }, "ms"),
    );
    this.node = panel("Delay by hop", "waterfall", [whole], list, this.warning.node);
  }

  /** `screen_ms`: the median of how long the page took from a message's arrival to drawing it. */
  refresh(robot: Robot, now: number, screen_ms: number): void {
    const delay = robot.medianDelay(now);
    this.median.set(delay ? milliseconds(delay.total) : NOTHING);
    const parts = this.shown.map((leg) => (leg === "screen" ? screen_ms : (delay?.[leg] ?? NaN)));
    const whole = parts.reduce((sum, part) => sum + Math.max(0, part || 0), 0);
    let before = 0;
    this.shown.forEach((leg, i) => {
      const part = Math.max(0, parts[i] || 0);
      const { bar, text } = this.rows.get(leg)!;
      text.set(milliseconds(parts[i]!));
      bar.style.setProperty("margin-inline-start", `${share(before, whole)}%`);
      bar.style.setProperty("width", `${share(part, whole)}%`);
      before += part;
    });
    const known = [...robot.streams.values()].some(({ hops }) => hops.offset_known);
    const clocks = known
      ? "The car's clock is corrected by the offset that it measured."
      : "The car has not measured its clock's offset: its clock is taken as it is.";
    const told = backwards(delay)
      ? "A hop takes less than no time: the clocks of car, cloud and this device disagree."
      : clocks;
    this.warning.set(`Medians of ${MEDIAN_S} s, so they are not the newest message's. ${told}`);
    setAttribute(this.warning.node, "data-bad", String(backwards(delay)));
  }
}

function share(part: number, whole: number): string {
  return (whole > 0 ? (part / whole) * 100 : 0).toFixed(1);
}

function backwards(delay: Delay | undefined): boolean {
  return delay !== undefined && LEGS.some((leg) => delay[leg] < -CLOCKS_MS);
}
