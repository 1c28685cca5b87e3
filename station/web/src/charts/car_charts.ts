// What the view of a car shows of the motor controller's fields, and how to know what else a car reports.

import { power_w, TEMPERATURES } from "../base/contract";
import type { Robot } from "../live/fleet";
import { AS_SENT, linear, times, type Linear } from "../base/format";
import type { GaugeOptions } from "./gauge";
import type { ChartPanelOptions } from "./chart_panel";
import type { XYChartOptions } from "./xy_chart";

export interface GaugeSpec extends GaugeOptions {
  /** The fields that need no tile because of this gauge. */
  readonly fields: readonly string[];
  /** The field whose least and most of the last while are shown. */
  readonly extent?: string;
  readonly show: (
    newest: (field: string) => number,
    robot: Robot,
    speed: Linear | undefined,
  ) => { readonly value: number; readonly as?: Linear; readonly unit?: string; readonly digits?: number };
}

const plain = (field: string, scale = 1): Pick<GaugeSpec, "fields" | "extent" | "show"> => ({
  fields: [field],
  extent: field,
  show: (newest) => ({ value: newest(field) * scale, as: times(scale) }),
});

/** The hottest of the controller's temperatures, as in the contract: a sensor that is not read is 0. */
export const hottest = (newest: (field: string) => number): number => {
  const known = TEMPERATURES.map(newest).filter((value) => !Number.isNaN(value) && value !== 0);
  return known.length > 0 ? Math.max(...known) : NaN;
};

export const GAUGES: readonly GaugeSpec[] = [
  {
    name: "speed_mps", label: "Speed", unit: "m/s", digits: 2, from: 0, to: 4,
    fields: [],
    extent: "speed",
    show: (newest, _, speed) =>
      speed ? { value: linear(newest("speed"), speed), as: speed } : { value: newest("speed"), unit: "erpm", digits: 0 },
  },
  { name: "voltage_input", label: "Battery", unit: "V", digits: 2, from: 9, to: 13, ...plain("voltage_input") },
  {
    name: "temperature", label: "Temperature, hottest", unit: "°C", digits: 1, from: 0, to: 100,
    fields: [],
    show: (newest) => ({ value: hottest(newest) }),
  },
  { name: "current_motor", label: "Motor current", unit: "A", digits: 2, from: -20, to: 40, ...plain("current_motor") },
  {
    name: "power_w", label: "Battery power", unit: "W", digits: 1, from: -100, to: 200,
    fields: [],
    show: (newest) => ({ value: power_w(newest("voltage_input"), newest("current_input")) }),
  },
  { name: "duty_cycle", label: "Duty cycle", unit: "%", digits: 1, from: -20, to: 100, ...plain("duty_cycle", 100) },
  {
    name: "delay", label: "Delay, car to page", unit: "ms", digits: 0, from: 0, to: 100,
    fields: [],
    show: (_, robot) => ({ value: robot.newestDelay()?.total ?? NaN }),
  },
];

interface VescPanel extends ChartPanelOptions {
  readonly fields: readonly string[];
  /** As what it is shown, and the unit that this gives, where it depends on the car. */
  readonly as: (speed: Linear | undefined) => readonly [Linear, string?];
}

const first = ([value = NaN]: readonly number[]): number => value;
const asSent = (): readonly [Linear] => [AS_SENT];

export const VESC_PANELS: readonly VescPanel[] = [
  {
    title: "Speed",
    fields: ["speed"],
    readings: [{ name: "speed", unit: "m/s", digits: 2, from: first }],
    chart: { lines: [{ colour: "--speed", fill: true }], span: 1, zero: true },
    as: (speed) => (speed ? [speed, "m/s"] : [AS_SENT, "erpm"]),
  },
  {
    title: "Battery voltage",
    fields: ["voltage_input"],
    readings: [{ name: "voltage_input", unit: "V", digits: 2, from: first }],
    chart: { lines: [{ colour: "--voltage" }], span: 1 },
    as: asSent,
  },
  {
    title: "Current",
    fields: ["current_motor", "current_input"],
    readings: [
      { name: "current_motor", label: "motor", unit: "A", digits: 2, line: 0, from: first },
      { name: "current_input", label: "battery", unit: "A", digits: 2, line: 1, from: ([, input = NaN]) => input },
    ],
    chart: { lines: [{ colour: "--motor" }, { colour: "--battery", dash: [5, 3] }], span: 4, zero: true },
    as: asSent,
  },
  {
    title: "Duty cycle",
    fields: ["duty_cycle"],
    readings: [{ name: "duty_cycle", unit: "%", digits: 1, from: first }],
    chart: { lines: [{ colour: "--duty", fill: true }], span: 10, zero: true },
    as: () => [times(100)],
  },
];

export const DELAY_PANEL: ChartPanelOptions = {
  title: "Delay",
  readings: [{ name: "delay", unit: "ms", digits: 0, from: first }],
  chart: { lines: [{ colour: "--delay", fill: true }], span: 20, zero: true },
};

export interface XYChartSpec extends Omit<XYChartOptions, "x"> {
  readonly x: string;
  readonly title: string;
  /** The x axis is the motor's speed, which is the car's where that is known. */
  readonly speed?: boolean;
  /** The stream's fields to draw, where it has them. */
  readonly axes: (fields: ReadonlyMap<string, number>) => readonly [string, string] | undefined;
}

// What poses are called in geometry_msgs, nav_msgs and tf2_msgs, and in flat messages of one's own.
const POSITIONS = ["pose.pose.position.", "pose.position.", "position.", "transform.translation.", "translation.", "pose.", ""];

export const XY_CHARTS: readonly XYChartSpec[] = [
  {
    title: "Speed and motor current",
    x: "speed",
    y: "motor current, A",
    span: [1, 10],
    zero: true,
    speed: true,
    axes: (fields) => (fields.has("speed") && fields.has("current_motor") ? ["speed", "current_motor"] : undefined),
  },
  {
    title: "Accelerations, G-G",
    x: "lateral, m/s²",
    y: "longitudinal, m/s²",
    span: [10, 10],
    equal: true,
    axes: (fields) => {
      const at = ["linear_acceleration.", "imu.linear_acceleration."].find((path) => fields.has(`${path}x`) && fields.has(`${path}y`));
      return at === undefined ? undefined : [`${at}y`, `${at}x`];
    },
  },
  {
    title: "Trajectory",
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
