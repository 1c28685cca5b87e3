// Writes and draws values with their intervals.

import type { EstimateEntry } from "../base/contract";
import { el } from "../base/dom";
import { number } from "../base/format";

/** How the page writes a unit of the catalogue. */
const UNITS: Readonly<Record<string, string>> = { "1": "%", ohm: "Ω", degC: "°C" };
const SMALL = new Set(["ohm", "Wb", "H"]);
// The room on either side of what is drawn, as a share of it.
const MARGIN = 0.08;

/** The factor and the unit in which values of about this size are written. */
export function scale(unit: string, size: number): readonly [factor: number, unit: string] {
  const name = UNITS[unit] ?? unit.replace(/2/g, "²");
  if (unit === "1") return [100, name];
  if (!SMALL.has(unit) || size === 0 || Math.abs(size) >= 0.1) return [1, name];
  return Math.abs(size) < 1e-4 ? [1e6, `µ${name}`] : [1e3, `m${name}`];
}

/** As many digits as the interval allows. */
export function digits(low: number, high: number): number | undefined {
  const width = Math.abs(high - low);
  return Number.isFinite(width) && width > 0
    ? Math.max(0, Math.min(6, 1 - Math.floor(Math.log10(width))))
    : undefined;
}

/** 41.2 mΩ (39.8 to 42.6) */
export function words(estimate: EstimateEntry, signed = false): string {
  const [factor, unit] = scale(estimate.unit, estimate.value);
  const [value, low, high] = [estimate.value, estimate.low, estimate.high].map((each) => each * factor) as [
    number,
    number,
    number,
  ];
  const places = digits(low, high);
  const sign = (each: number): string => `${signed && each > 0 ? "+" : ""}${number(each, places)}`;
  return `${sign(value)} ${unit} (${sign(low)} to ${sign(high)})`;
}

/** The sum of a baseline and a change. */
export const changed = (usual: EstimateEntry, { value, low, high }: EstimateEntry): EstimateEntry => ({
  ...usual,
  value: usual.value + value,
  low: usual.value + low,
  high: usual.value + high,
});

/** A bar from low to high with the value on it; behind it, where it usually is. Without that, it begins at zero. */
export function intervalBar(now: EstimateEntry, usual: EstimateEntry | null): HTMLElement {
  const ends = [now.low, now.value, now.high, ...(usual ? [usual.low, usual.high] : [0])];
  const [least, most] = [Math.min(...ends), Math.max(...ends)];
  const span = Math.max(most - least, Math.abs(most) * 1e-6, 1e-12) * (1 + 2 * MARGIN);
  const at = (value: number): string => `${(((value - (least + most) / 2) / span + 0.5) * 100).toFixed(2)}%`;
  const part = (name: string, low: number, high: number): HTMLElement => {
    const node = el("span", { class: name });
    node.style.setProperty("--low", at(low));
    node.style.setProperty("--high", at(high));
    return node;
  };
  const behind = usual ? part("interval-usual", usual.low, usual.high) : part("interval-zero", 0, 0);
  const said = `${words(now)}${usual ? `, usually ${words(usual)}` : ""}`;
  return el(
    "span",
    { class: "interval", role: "img", "aria-label": said },
    behind,
    part("interval-now", now.low, now.high),
    part("interval-value", now.value, now.value),
  );
}
