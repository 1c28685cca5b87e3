// An alarm on a condition of one's own, set on a chart: its threshold is typed, or dragged. It is counted over the range
// before it is added to the robot's event recorder, as a trigger that only tells.

import type { DryRunAnswer, KeepAnswer } from "../base/contract";
import { button, choices, el, form } from "../base/dom";
import { number, type Spec } from "../base/format";
import { inUs, type Range } from "../base/range";
import { extremes } from "../charts/spoken";
import { act, ask, Latest, words } from "../server/answers";
import type { Chart } from "./chart";
import type { Field, Past } from "./past";

const COUNTED_AFTER_MS = 400;
const DAY_S = 86_400;
/** The recorder tells of an alarm once in this time. */
const COOLDOWN_S = "60";
const SIGNS = [
  [">", "above"],
  ["<", "below"],
] as const;

export interface AlarmFormOptions {
  readonly past: () => Past | undefined;
  readonly range: () => Range;
  /** The robot has another trigger. */
  readonly added: () => void;
}

export class AlarmForm {
  /** Opens and closes the form. */
  readonly toggle = button("\u2277", () => this.show(this.toggle.ariaExpanded !== "true"), {
    class: "tool alarm-open",
    "aria-expanded": "false",
    "aria-label": "Alarm",
    title: "Alarm: tell when a value is above or below a threshold",
  });
  private readonly field = el("select", { "aria-label": "Field" });
  private readonly sign = el("select", { "aria-label": "When it is" }, ...choices(SIGNS));
  private readonly value = el("input", {
    type: "number",
    step: "any",
    required: "",
    "aria-label": "Threshold",
  });
  private readonly unit = el("span", { class: "unit" });
  private readonly span = el("input", { type: "number", min: "0", max: "3600", step: "any", value: "2" });
  private readonly name = el("input", {
    ...{ type: "text", required: "", maxlength: "64", pattern: "[A-Za-z0-9_\\-]+", spellcheck: "false" },
    ...{ autocomplete: "off", title: "Letters, digits, _ and -" },
  });
  private readonly condition = el("code");
  private readonly count = el("p", { class: "note said", role: "status" });
  private readonly add = el("button", { type: "submit", class: "tool primary", disabled: "" }, "Add alarm");
  private readonly node = form(
    { class: "range alarm-form", hidden: "" },
    () => void this.send(),
    this.field,
    this.sign,
    el("label", {}, this.value, this.unit),
    el("label", {}, "for ", this.span, " s"),
    el("label", {}, "name ", this.name),
    this.add,
    this.condition,
    this.count,
  );
  private readonly counting = new Latest();
  private timer: number | undefined;
  /** The condition that was counted. */
  private counted = "";
  private named = "";

  constructor(
    private readonly chart: Chart<Past>,
    private readonly fields: readonly string[],
    private readonly options: AlarmFormOptions,
  ) {
    chart.panel.aside.append(this.toggle);
    chart.node.querySelector("header")!.after(this.node);
    for (const input of [this.field, this.sign, this.value, this.span])
      input.addEventListener("input", () => {
        if (input === this.field) this.begin();
        this.changed();
      });
  }

  private get past(): Past {
    return this.options.past()!;
  }

  private get chosen(): Field | undefined {
    return this.past.field(this.field.value);
  }

  private show(open: boolean): void {
    this.node.hidden = !open;
    this.toggle.setAttribute("aria-expanded", String(open));
    this.counting.stop();
    this.chart.limit(undefined);
    if (!open) return;
    const there = this.fields.filter((key) => this.past.field(key));
    this.field.replaceChildren(...choices(there.map((key) => [key, this.past.label(key)] as const)));
    this.field.hidden = there.length < 2;
    this.begin();
    this.changed();
    this.value.focus();
  }

  /** Begin in the upper part of what the field was. */
  private begin(): void {
    const { spec, columns } = this.chosen!;
    const { least, most } = extremes(columns[0]! as readonly (number | null)[]);
    this.value.value = rounded(least + 0.8 * (most - least), spec, most - least);
    this.unit.textContent = spec.unit;
  }

  /** Show the threshold on the chart, and count the condition. */
  private changed(): void {
    const field = this.chosen;
    const value = this.value.valueAsNumber;
    const condition = field && !Number.isNaN(value) ? this.when(field) : "";
    this.condition.textContent = condition;
    const suggested =
      `${field?.field.replace(/\W+/g, "_") ?? ""}_${this.sign.value === ">" ? "high" : "low"}`.slice(-64);
    if (this.name.value === this.named) this.name.value = this.named = suggested;
    this.add.disabled = true;
    window.clearTimeout(this.timer);
    this.counting.stop();
    if (!field || !condition) return;
    const { spec, columns } = field;
    const { least, most } = extremes(columns[0]! as readonly (number | null)[]);
    this.chart.limit({
      value,
      line: Math.max(0, this.fields.filter((key) => this.past.field(key)).indexOf(this.field.value)),
      write: (at) => `${number(at, spec.digits)} ${spec.unit}`,
      moved: (to) => {
        this.value.value = rounded(to, spec, most - least);
        this.changed();
      },
    });
    this.say("", "Counting …");
    this.timer = window.setTimeout(() => void this.find(condition), COUNTED_AFTER_MS);
  }

  /** The condition, of what the robot sends. */
  private when({ field, spec }: Field): string {
    const value = this.value.valueAsNumber;
    // The speed of the car is a field of its own, which the robot derives.
    const speed = field === "speed" && spec.unit === "m/s" && spec.scale !== 1;
    const sent = speed ? value : (value - spec.shift) / spec.scale;
    const span = this.span.valueAsNumber;
    // As typed: a latitude or a count has more than a few digits, and a scale leaves noise in the last ones.
    return `${speed ? "speed_mps" : field} ${this.sign.value} ${Number(sent.toPrecision(12))}${span > 0 ? ` for ${span}s` : ""}`;
  }

  private asked(): Readonly<Record<string, string>> {
    const { stream } = this.chosen!;
    return { robot: this.past.robot, stream, when: this.condition.textContent!, cooldown_s: COOLDOWN_S };
  }

  private async find(condition: string): Promise<void> {
    const [from, to] = this.options.range();
    const long = to - from > DAY_S;
    const range: Range = [long ? to - DAY_S : from, to];
    await this.counting.run(
      async (signal) => {
        const { edges, told, samples } = await ask<DryRunAnswer>(
          "dry_run",
          { ...this.asked(), ...inUs(range) },
          signal,
        );
        this.counted = condition;
        this.add.disabled = false;
        const times = (count: number): string => (count === 1 ? "once" : `${number(count)} times`);
        const happened = edges === 0 ? "never have come true" : `have come true ${times(edges)}`;
        const tells = edges > 1 ? `, and told of it ${times(told)}` : "";
        this.say(
          "",
          `In ${long ? "the last day of this range" : "this range"} it would ${happened}${tells} (${number(samples)} samples). It tells at most once a minute.`,
        );
      },
      (reason) => this.say("bad", reason),
    );
  }

  private async send(): Promise<void> {
    if (this.counted !== this.condition.textContent) return;
    const { robot } = this.past;
    this.add.disabled = true;
    this.say("", `Waiting for ${robot} …`);
    try {
      const answer = await act<KeepAnswer>("add_trigger", { ...this.asked(), name: this.name.value });
      this.say(...answered(robot, answer));
      this.options.added();
    } catch (error) {
      this.say("bad", words(error));
    }
    this.add.disabled = false;
  }

  private say(kind: string, text: string): void {
    this.count.dataset.kind = kind;
    this.count.textContent = text;
  }
}

function answered(robot: string, { accepted, reason, online }: KeepAnswer): readonly [string, string] {
  if (accepted) return ["good", `${robot} has accepted it.`];
  if (accepted === false) return ["bad", `${robot} refuses: ${reason}. It is taken back.`];
  if (online) return ["bad", "No answer yet. Does its agent run, and has its car.yaml the section recorder?"];
  return ["", `${robot} is not connected: it answers when it is back.`];
}

/** A threshold as precise as the field's digits, or as the range of its values needs. */
function rounded(value: number, { digits }: Spec, span: number): string {
  const places = digits ?? Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(span || 1))));
  return String(Number(value.toFixed(places)));
}
