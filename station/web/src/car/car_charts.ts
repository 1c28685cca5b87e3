// The gauges and charts of a car's view. To add one, add an entry to `GAUGES` or `CHARTS`.

import { power_w } from "../base/contract";
import { AS_SENT, type Linear, linear, POSITIONS, times } from "../base/format";
import type { ChartPanelOptions } from "../charts/chart_panel";
import type { GaugeOptions } from "../charts/gauge";
import type { XYChartOptions } from "../charts/xy_chart";
import { hottest, type Robot } from "../live/robot";

/** A number with a bar. */
export interface GaugeSpec extends GaugeOptions {
  /** The fields that need no tile because of this gauge. */
  readonly fields: readonly string[];
  /** The field whose minimum and maximum of the last 30 s are shown. */
  readonly extent?: string;
  readonly show: (
    newest: (field: string) => number,
    robot: Robot,
    speed: Linear | undefined,
  ) => { readonly value: number; readonly as?: Linear; readonly unit?: string; readonly digits?: number };
}

/** Lines over time. */
export interface LineSpec extends ChartPanelOptions {
  readonly kind: "line";
  /** Its name in addresses. */
  readonly key: string;
  /** A field for each line. */
  readonly fields: readonly string[];
  /** The scale, and the unit and the digits if they depend on the car. */
  readonly as: (speed: Linear | undefined) => readonly [Linear, string?, number?];
}

/** One field over another. */
export interface XYChartSpec extends Omit<XYChartOptions, "x"> {
  readonly kind: "xy";
  /** Its name in addresses. */
  readonly key: string;
  readonly x: string;
  readonly title: string;
  /** The x axis is the motor's speed, shown as the car's speed if the car's parameters are known. */
  readonly speed?: boolean;
  /** The x and y of a map: the track is drawn below. */
  readonly map?: boolean;
  /** The two fields to draw; undefined for a stream without them. */
  readonly axes: (fields: ReadonlyMap<string, number>) => readonly [string, string] | undefined;
}

/** The delay of every message. */
export interface DelaySpec extends ChartPanelOptions {
  readonly kind: "delay";
  readonly key: string;
}

const first = ([value = NaN]: readonly number[]): number => value;
const asSent = (): readonly [Linear] => [AS_SENT];

/** A gauge of one field. */
const ofField = (field: string, scale = 1): Pick<GaugeSpec, "fields" | "extent" | "show"> => ({
  fields: [field],
  extent: field,
  show: (newest) => ({ value: newest(field) * scale, as: times(scale) }),
});

const gauge = (
  name: string,
  label: string,
  [unit, digits]: readonly [string, number],
  [from, to]: readonly [number, number],
  more: Pick<GaugeSpec, "fields" | "extent" | "show">,
): GaugeSpec => ({ name, label, unit, digits, from, to, ...more });

export const GAUGES: readonly GaugeSpec[] = [
  gauge("speed_mps", "Speed", ["m/s", 2], [0, 4], {
    fields: [],
    extent: "speed",
    show: (newest, _, speed) =>
      speed
        ? { value: linear(newest("speed"), speed), as: speed }
        : { value: newest("speed"), unit: "erpm", digits: 0 },
  }),
  gauge("voltage_input", "Battery", ["V", 2], [9, 13], ofField("voltage_input")),
  gauge("temperature", "Temperature, hottest", ["°C", 1], [0, 100], {
    fields: [],
    show: (newest) => ({ value: hottest(newest) }),
  }),
  gauge("current_motor", "Motor current", ["A", 2], [-20, 40], ofField("current_motor")),
  gauge("power_w", "Battery power", ["W", 1], [-100, 200], {
    fields: [],
    show: (newest) => ({ value: power_w(newest("voltage_input"), newest("current_input")) }),
  }),
  gauge("duty_cycle", "Duty cycle", ["%", 1], [-20, 100], ofField("duty_cycle", 100)),
  gauge("delay", "Delay of the newest message", ["ms", 0], [0, 100], {
    fields: [],
    show: (_, robot) => ({ value: robot.newestDelay()?.total ?? NaN }),
  }),
];

const CHARTS: readonly (LineSpec | XYChartSpec)[] = [
  {
    kind: "line",
    key: "speed",
    title: "Speed",
    fields: ["speed"],
    readings: [{ name: "speed", unit: "m/s", digits: 2, from: first }],
    chart: { lines: [{ colour: "--speed", fill: true }], span: 1, zero: true },
    as: (speed) => (speed ? [speed, "m/s"] : [AS_SENT, "erpm", 0]),
  },
  {
    kind: "line",
    key: "battery",
    title: "Battery voltage",
    fields: ["voltage_input"],
    readings: [{ name: "voltage_input", unit: "V", digits: 2, from: first }],
    chart: { lines: [{ colour: "--voltage" }], span: 1 },
    as: asSent,
  },
  {
    kind: "line",
    key: "currents",
    title: "Current",
    fields: ["current_motor", "current_input"],
    readings: [
      { name: "current_motor", label: "motor", unit: "A", digits: 2, line: 0, from: first },
      {
        name: "current_input",
        label: "battery",
        unit: "A",
        digits: 2,
        line: 1,
        from: ([, input = NaN]) => input,
      },
    ],
    chart: { lines: [{ colour: "--motor" }, { colour: "--battery", dash: [5, 3] }], span: 4, zero: true },
    as: asSent,
  },
  {
    kind: "line",
    key: "duty",
    title: "Duty cycle",
    fields: ["duty_cycle"],
    readings: [{ name: "duty_cycle", unit: "%", digits: 1, from: first }],
    chart: { lines: [{ colour: "--duty", fill: true }], span: 10, zero: true },
    as: () => [times(100)],
  },
  {
    kind: "xy",
    key: "speed-current",
    title: "Speed and motor current",
    x: "speed",
    y: "motor current, A",
    span: [1, 10],
    zero: true,
    speed: true,
    axes: (fields) =>
      fields.has("speed") && fields.has("current_motor") ? ["speed", "current_motor"] : undefined,
  },
  {
    kind: "xy",
    key: "g-g",
    title: "Accelerations, G-G",
    x: "lateral, m/s²",
    y: "longitudinal, m/s²",
    span: [10, 10],
    equal: true,
    axes: (fields) => {
      const at = ["linear_acceleration.", "imu.linear_acceleration."].find(
        (path) => fields.has(`${path}x`) && fields.has(`${path}y`),
      );
      return at === undefined ? undefined : [`${at}y`, `${at}x`];
    },
  },
  {
    kind: "xy",
    key: "trajectory",
    title: "Trajectory",
    map: true,
    x: "x, m",
    y: "y, m",
    span: [2, 2],
    equal: true,
    axes: (fields) => {
      const at = POSITIONS.find((path) => fields.has(`${path}x`) && fields.has(`${path}y`));
      return at === undefined ? undefined : [`${at}x`, `${at}y`];
    },
  },
];

/** The delay by message, beside its hops. */
const DELAY: DelaySpec = {
  kind: "delay",
  key: "delay",
  title: "Delay of each message",
  readings: [{ name: "delay", unit: "ms", digits: 0, from: first }],
  chart: { lines: [{ colour: "--delay", fill: true }], span: 20, zero: true },
};

/** The charts that are shown unless the viewer chooses, by their keys and in their order. */
export const BOARD: ReadonlyMap<string, LineSpec | XYChartSpec | DelaySpec> = new Map(
  [...CHARTS, DELAY].map((chart) => [chart.key, chart]),
);
