// The controls of a range: its ends, the last minutes, the stream.

import { button, choices, el, form, Text } from "../base/dom";
import { zone } from "../base/format";
import type { Range } from "../base/range";

const LAST = [
  ["1 min", 60],
  ["5 min", 300],
  ["15 min", 900],
  ["1 h", 3600],
] as const;
const FORM = "2026-05-04 14:03:27";
const TYPED = {
  size: String(FORM.length + 1),
  placeholder: FORM,
  title: `Date and time, like ${FORM}`,
  autocomplete: "off",
  spellcheck: "false",
};
// Shorter ranges show milliseconds.
const FINE_S = 20;

export interface RangeFormEvents {
  readonly range: (range: Range) => void;
  /** A text that is no time, for the viewer. */
  readonly wrong: (text: string) => void;
  readonly last: (seconds: number) => void;
  readonly stream: () => void;
  readonly out: () => void;
}

export class RangeForm {
  readonly node: HTMLFormElement;
  // Not of the type for times: some browsers write those with AM and PM, whatever the page says.
  private readonly from = el("input", { type: "text", id: "from", name: "from", ...TYPED });
  private readonly to = el("input", { type: "text", id: "to", name: "to", ...TYPED });
  private readonly zone = new Text("zone");
  private readonly select = el("select", { id: "stream", name: "stream" });
  /** Goes back to the range before the zoom. */
  readonly out: HTMLElement;

  constructor(events: RangeFormEvents) {
    this.out = button("Zoom out", events.out, { hidden: "", title: "Also: a double click on a chart" });
    this.node = form(
      { class: "range", novalidate: "" },
      () => this.submit(events),
      ...LAST.map(([label, seconds]) => button(`Last ${label}`, () => events.last(seconds))),
      el("label", {}, "from ", this.from),
      el("label", {}, "to ", this.to, " ", this.zone.node),
      el("label", {}, "stream ", this.select),
      el("button", { type: "submit", class: "tool primary" }, "Load"),
    );
    this.select.addEventListener("change", events.stream);
    for (const each of [this.from, this.to]) each.addEventListener("input", () => this.sayZone());
  }

  get stream(): string {
    return this.select.value;
  }

  /** Choose a stream; one that the car does not have is left out. */
  set stream(name: string) {
    if ([...this.select.options].some(({ value }) => value === name)) this.select.value = name;
  }

  streams(names: readonly string[]): void {
    this.select.replaceChildren(...choices(names));
  }

  private submit(events: RangeFormEvents): void {
    const wrong = [this.from, this.to].find((input) => Number.isNaN(seconds(input)));
    if (wrong) events.wrong(`${wrong.name} must be a date and a time like ${FORM}, got "${wrong.value}".`);
    else events.range([seconds(this.from), seconds(this.to)]);
  }

  show([from, to]: Range, zoomed: boolean): void {
    const digits = to - from < FINE_S ? 23 : 19;
    this.from.value = local(from).slice(0, digits);
    this.to.value = local(to).slice(0, digits);
    this.out.hidden = !zoomed;
    this.sayZone();
  }

  /** Show the time zone of the form's times; it may change with the season. */
  private sayZone(): void {
    const zones = [this.from, this.to]
      .map(seconds)
      .filter((at) => !Number.isNaN(at))
      .map(zone);
    this.zone.set([...new Set(zones)].join(" to "));
  }
}

/** A time in the input's format, in this device's time zone. */
function local(at: number): string {
  return new Date((at - new Date(at * 1000).getTimezoneOffset() * 60) * 1000)
    .toISOString()
    .slice(0, 23)
    .replace("T", " ");
}

/** NaN for a text that is no date with a time. */
function seconds({ value }: HTMLInputElement): number {
  return /^\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?$/.test(value.trim())
    ? new Date(value.trim().replace(" ", "T")).getTime() / 1000
    : NaN;
}
