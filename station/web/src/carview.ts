// One car in full: the charts, the delay by hop, and a tile for every field of every stream.

import { Chart, type ChartOptions, type Line } from "./chart";
import type { FieldTable } from "./config";
import { byName, el, setAttribute, Text } from "./dom";
import { CHARTED, MEDIAN_S, numeric, STALE_S, type Fleet, type Robot, type Stream } from "./fleet";
import { age, milliseconds, NOTHING, number, spec, write, type Spec } from "./format";
import type { Ring } from "./ring";

type Charted = (typeof CHARTED)[number];

/** A value in a panel's heading, computed from those of the panel's lines. */
interface Reading {
  readonly label?: string;
  readonly unit: string;
  readonly digits: number;
  readonly line?: number;
  readonly name: string;
  readonly from: (values: readonly number[], gain: number | undefined) => number;
}

/** A heading with its readings, and a chart below it. Under the pointer, the readings are of that time. */
class Panel {
  readonly node: HTMLElement;
  private readonly texts: Text[];
  private readonly note = new Text("note");
  private readonly chart: Chart;
  private hovered = false;
  private gain: number | undefined;

  constructor(
    host: HTMLElement,
    title: string,
    private readonly readings: readonly Reading[],
    options: ChartOptions,
  ) {
    this.texts = readings.map(({ name }) => new Text("num", "span", { "data-value": name }));
    const heading = el(
      "header",
      {},
      el("h3", {}, title),
      this.note.node,
      ...readings.map(({ label, unit, line }, i) =>
        el(
          "p",
          { class: "reading" },
          ...(line === undefined ? [] : [el("span", { class: `key ${options.lines[line]!.colour.slice(2)}` })]),
          ...(label ? [el("span", { class: "label" }, label)] : []),
          this.texts[i]!.node,
          el("span", { class: "unit" }, unit),
        ),
      ),
    );
    const plot = el("div", { class: "plot", "aria-hidden": "true" });
    this.node = el("section", { class: "panel", "aria-label": title }, heading, plot);
    host.append(this.node);
    this.chart = new Chart(plot, {
      ...options,
      onPoint: (point) => {
        this.hovered = point !== undefined;
        setAttribute(this.node, "data-hover", String(this.hovered));
        if (point) {
          this.read(point.values);
          this.note.set(`${age(point.ago)} ago`);
        }
      },
    });
  }

  show(history: Ring | undefined, gain: number | undefined, scale: number): void {
    this.gain = gain;
    this.readings.forEach(({ name }, i) => {
      if (name === "speed_mps") this.texts[i]!.node.parentElement!.hidden = gain === undefined;
    });
    this.chart.show(history, scale);
  }

  update(values: readonly number[], note: string): void {
    if (this.hovered) return;
    this.read(values);
    this.note.set(note);
    this.chart.wake();
  }

  due(now: number): boolean {
    return this.chart.due(now);
  }

  draw(now: number): void {
    this.chart.draw(now);
  }

  private read(values: readonly number[]): void {
    this.readings.forEach(({ digits, from }, i) => this.texts[i]!.set(number(from(values, this.gain), digits)));
  }
}

const first = (values: readonly number[]): number => values[0] ?? NaN;
const line = (field: Charted, colour: string, more: Partial<Line> = {}): Line => ({
  column: 1 + CHARTED.indexOf(field),
  colour,
  ...more,
});

interface VescPanel {
  readonly title: string;
  readonly fields: readonly Charted[];
  readonly readings: readonly Reading[];
  readonly chart: ChartOptions;
}

const VESC_PANELS: readonly VescPanel[] = [
  {
    title: "Speed",
    fields: ["speed"],
    readings: [
      { name: "speed_mps", unit: "m/s", digits: 2, from: ([erpm], gain) => (erpm ?? NaN) / (gain ?? NaN) },
      { name: "speed", unit: "erpm", digits: 0, from: first },
    ],
    chart: { lines: [line("speed", "--speed", { fill: true })], span: 1, zero: true },
  },
  {
    title: "Battery voltage",
    fields: ["voltage_input"],
    readings: [{ name: "voltage_input", unit: "V", digits: 2, from: first }],
    chart: { lines: [line("voltage_input", "--voltage")], span: 1 },
  },
  {
    title: "Current",
    fields: ["current_motor", "current_input"],
    readings: [
      { name: "current_motor", label: "motor", unit: "A", digits: 2, line: 0, from: first },
      { name: "current_input", label: "battery", unit: "A", digits: 2, line: 1, from: ([, input]) => input ?? NaN },
    ],
    chart: {
      lines: [line("current_motor", "--motor"), line("current_input", "--battery", { dash: [5, 3] })],
      span: 4,
      zero: true,
    },
  },
  {
    title: "Duty cycle",
    fields: ["duty_cycle"],
    readings: [{ name: "duty_cycle", unit: "%", digits: 1, from: ([share]) => (share ?? NaN) * 100 }],
    chart: { lines: [line("duty_cycle", "--duty", { fill: true })], span: 10, zero: true },
  },
];

const HOPS = [
  ["toCloud", "Car to cloud rule", "--hop-cloud"],
  ["toLambda", "Rule to Lambda", "--hop-lambda"],
  ["toPage", "Lambda to page", "--hop-page"],
] as const;

/** The delay from car to page: newest, median, chart, and where the time goes. */
class DelayPanel extends Panel {
  private readonly median = new Text("num", "span", { "data-value": "delay_median" });
  private readonly bars: HTMLElement[] = [];
  private readonly hopTexts: Text[] = [];
  private readonly warning = new Text("warning", "p");

  constructor(host: HTMLElement) {
    super(host, "Delay", [{ name: "delay", unit: "ms", digits: 0, from: first }], {
      lines: [{ column: 1, colour: "--delay", fill: true }],
      span: 20,
      zero: true,
    });
    const bar = el("div", { class: "hops", "aria-hidden": "true" });
    const list = el(
      "dl",
      { class: "hop-list" },
      el("dt", { class: "total" }, `Car to page, median of ${MEDIAN_S} s`),
      el("dd", { class: "total" }, this.median.node, el("span", { class: "unit" }, "ms")),
    );
    for (const [hop, label, colour] of HOPS) {
      const segment = el("span", { class: colour.slice(2) });
      const text = new Text("num", "span", { "data-value": `hop_${hop}` });
      this.bars.push(segment);
      this.hopTexts.push(text);
      bar.append(segment);
      list.append(
        el("dt", {}, el("span", { class: `key ${colour.slice(2)}` }), label),
        el("dd", {}, text.node, el("span", { class: "unit" }, "ms")),
      );
    }
    this.node.append(bar, list, this.warning.node);
  }

  refresh(robot: Robot | undefined, now: number): void {
    this.update([robot?.newestDelay()?.total ?? NaN], "");
    const median = robot?.medianDelay(now);
    this.median.set(median ? milliseconds(median.total) : NOTHING);
    const parts = HOPS.map(([hop]) => median?.[hop] ?? NaN);
    parts.forEach((part, i) => {
      this.hopTexts[i]!.set(milliseconds(part));
      // As wide as its share; a hop that clocks make negative has no width.
      this.bars[i]!.style.setProperty("flex-grow", Number.isFinite(part) ? Math.max(0, part).toFixed(2) : "0");
    });
    const backwards = parts.some((part) => part < -5);
    this.warning.set(backwards ? "A hop takes less than no time: the clocks of car, cloud and this device disagree." : "");
  }
}

/** A field's newest value. */
class Tile {
  readonly node: HTMLElement;
  private readonly value: Text;

  constructor(
    field: string,
    private readonly spec: Spec,
  ) {
    this.value = new Text("num", "span", { "data-value": field });
    const { label, unit, meaning } = spec;
    this.node = el(
      "div",
      { class: "tile", title: meaning ? `${field}: ${meaning}` : field },
      el("dt", {}, label),
      el("dd", {}, this.value.node, ...(unit ? [el("span", { class: "unit" }, unit)] : [])),
      ...(meaning ? [el("dd", { class: "meaning" }, meaning)] : []),
    );
  }

  set(value: Parameters<typeof write>[0]): void {
    this.value.set(write(value, this.spec));
    setAttribute(this.node, "data-text", String(typeof value === "string" || (this.spec.texts !== undefined && value !== 0)));
  }
}

/** A stream's heading and the tiles of its fields. */
class StreamSection {
  readonly node: HTMLElement;
  private readonly facts = new Text("facts");
  private readonly list = el("dl", { class: "tiles" });
  private readonly tiles = new Map<string, Tile>();
  private power: Tile | undefined;
  private drawn = -1;

  constructor(
    private readonly stream: Stream,
    private readonly table: FieldTable,
    private readonly vesc: boolean,
  ) {
    this.node = el(
      "section",
      { class: "stream", "aria-label": `Stream ${stream.name}`, "data-stream": stream.name },
      el("header", {}, el("h3", {}, stream.name), this.facts.node),
      this.list,
    );
  }

  update(now: number): void {
    const { stream } = this;
    const old = now - stream.takenAt;
    setAttribute(this.node, "data-stale", String(old > STALE_S));
    const rate = `${stream.rate(now).toFixed(1)} Hz`;
    this.facts.set(`${old > STALE_S ? `${age(old)} old` : rate} · message ${stream.seq} of run ${stream.boot.slice(0, 8)}`);
    if (stream.version === this.drawn) return;
    this.drawn = stream.version;
    this.arrange();
    for (const [field, tile] of this.tiles) tile.set(stream.sample.get(field));
    const watts = numeric(stream.sample.get("voltage_input")) * numeric(stream.sample.get("current_input"));
    this.power?.set(Number.isNaN(watts) ? null : watts);
  }

  /** A tile for every field ever seen of this stream, the contract's first and in its order. */
  private arrange(): void {
    const fresh = [...this.stream.sample.keys()].filter(
      (field) => !this.tiles.has(field) && !(this.vesc && (CHARTED as readonly string[]).includes(field)),
    );
    if (fresh.length === 0 && (this.power || !this.vesc)) return;
    if (this.vesc && !this.power) {
      const meaning = "battery voltage times battery current";
      this.power = new Tile("power_w", { label: "Battery power", unit: "W", meaning, scale: 1, digits: 1 });
      this.list.append(this.power.node);
    }
    for (const field of fresh) this.tiles.set(field, new Tile(field, spec(field, this.table)));
    const known = Object.keys(this.table.fields);
    const place = (field: string): number => (known.includes(field) ? known.indexOf(field) : known.length);
    const ordered = [...this.tiles].sort(([a], [b]) => place(a) - place(b));
    this.list.append(...ordered.map(([, tile]) => tile.node));
  }
}

export class CarView {
  private readonly title = new Text("car-name", "h2");
  private readonly state = new Text("car-state");
  private readonly fault = el("p", { class: "fault", role: "alert", hidden: "" });
  private readonly panels: Panel[];
  private readonly delay: DelayPanel;
  private readonly charts = el("div", { class: "charts" });
  private readonly streams = el("div", { class: "streams" });
  private readonly sections = new Map<Stream, StreamSection>();
  private robot: Robot | undefined;
  private drawn = -1;

  constructor(
    private readonly host: HTMLElement,
    private readonly fleet: Fleet,
    private readonly table: FieldTable,
  ) {
    const aside = el("aside", { class: "aside" });
    host.append(
      el("header", { class: "car-head" }, this.title.node, this.state.node, this.fault),
      el("div", { class: "board" }, this.charts, aside),
      this.streams,
    );
    this.panels = VESC_PANELS.map(({ title, readings, chart }) => new Panel(this.charts, title, readings, chart));
    this.delay = new DelayPanel(aside);
  }

  show(robot: Robot | undefined): void {
    if (this.robot !== robot) {
      this.robot = robot;
      this.sections.clear();
      this.streams.replaceChildren();
      this.drawn = -1;
      this.title.set(robot?.name ?? "");
    }
    this.arrange();
  }

  /** Sections for the streams there are; called when a stream is heard for the first time. */
  arrange(): void {
    const { robot, table } = this;
    if (!robot) return;
    const vesc = robot.vesc(table);
    const gain = this.fleet.gain(robot.name);
    this.charts.hidden = vesc === undefined;
    this.panels.forEach((panel, i) => {
      const { title } = VESC_PANELS[i]!;
      panel.show(vesc?.history, gain, title === "Speed" && gain ? 1 / gain : title === "Duty cycle" ? 100 : 1);
    });
    this.delay.show(robot.delays, undefined, 1);
    const ordered = [...robot.streams.values()].sort((a, b) => Number(b === vesc) - Number(a === vesc) || byName(a.name, b.name));
    for (const stream of ordered) {
      let section = this.sections.get(stream);
      if (!section) {
        section = new StreamSection(stream, table, stream === vesc);
        this.sections.set(stream, section);
      }
      this.streams.append(section.node);
    }
  }

  /** What changes with every message. */
  values(now: number): void {
    const { robot, table } = this;
    if (!robot || robot.version === this.drawn) return;
    this.drawn = robot.version;
    const vesc = robot.vesc(table);
    this.panels.forEach((panel, i) => {
      panel.update(VESC_PANELS[i]!.fields.map((field) => numeric(vesc?.sample.get(field))), "");
    });
    const fault = robot.fault(table);
    const text = fault ? `Fault: ${fault}` : "";
    if (this.fault.textContent !== text) this.fault.textContent = text;
    this.fault.hidden = !fault;
    this.clock(now, undefined);
  }

  /** What changes with time alone. */
  clock(now: number, linked: boolean | undefined): void {
    const { robot } = this;
    if (!robot) return;
    for (const section of this.sections.values()) section.update(now);
    this.delay.refresh(robot, now);
    if (linked === undefined) return;
    const fresh = robot.freshness(now);
    setAttribute(this.host, "data-state", linked || fresh === "live" ? fresh : "unlinked");
    const texts = {
      live: "live",
      stale: `stale: newest values are ${age(now - robot.takenAt)} old`,
      gone: `gone: last heard ${age(now - robot.heardAt)} ago`,
    };
    this.state.set(linked || fresh === "live" ? texts[fresh] : `no connection: values are ${age(now - robot.heardAt)} old`);
  }

  draw(now: number): void {
    if (!this.robot) return;
    const panels = this.charts.hidden ? [this.delay] : [...this.panels, this.delay];
    // All in the same frame: a frame costs more than what is drawn in it.
    if (panels.some((panel) => panel.due(now))) for (const panel of panels) panel.draw(now);
  }
}
