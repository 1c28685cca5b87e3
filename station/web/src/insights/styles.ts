// How the car was driven: the shares of each style in the time of a drive, as a bar.

import type { DriveEntry, ParameterEntry } from "../base/contract";
import { el } from "../base/dom";
import { capital, number, when } from "../base/format";

const COLOURS = ["--line", "--hue-5", "--hue-3", "--hue-2", "--hue-4", "--hue-1", "--hue-6"];
// Bars of older drives show how the style changes.
const DRIVES = 6;
const LEAST = 0.001;

/** Bars of the newest drives; undefined if none has a style. */
export function styles(
  drives: readonly DriveEntry[],
  group: Readonly<Record<string, ParameterEntry>>,
): HTMLElement | undefined {
  const names = Object.keys(group);
  const known = drives
    .filter(({ estimates }) => names.some((name) => Object.hasOwn(estimates, name)))
    .slice(0, DRIVES);
  if (known.length === 0) return undefined;
  const bars = known.map((drive) => {
    const shares = names.map((name) => drive.estimates[name]?.value ?? 0);
    const said = names.flatMap((name, i) =>
      shares[i]! >= LEAST ? [`${label(name)} ${percent(shares[i]!)}`] : [],
    );
    const bar = el(
      "span",
      { class: "shares", role: "img", "aria-label": said.join(", ") },
      ...shares.map((share, i) => piece(share, i, percent(share))),
    );
    return el(
      "div",
      { class: "style-row" },
      el("span", { class: "note" }, when(drive.from_us / 1e6, { second: undefined })),
      bar,
    );
  });
  const newest = known[0]!.estimates;
  const keys = names.flatMap((name, i) => {
    const share = newest[name];
    if (!share || share.value < LEAST) return [];
    return [
      el(
        "li",
        { title: group[name]!.meaning },
        piece(1, i, ""),
        ` ${capital(label(name))} `,
        el("b", {}, percent(share.value)),
        ` (${percent(share.low)} to ${percent(share.high)})`,
      ),
    ];
  });
  return el(
    "section",
    { class: "panel styles", "aria-label": "Driving style" },
    el("h3", {}, "Driving style"),
    ...bars,
    el("ul", { class: "legend" }, ...keys),
  );
}

function piece(share: number, i: number, text: string): HTMLElement {
  const node = el("span", { class: "share", "aria-hidden": "true" }, share >= 0.08 ? text : "");
  node.style.setProperty("--share", String(share));
  node.style.setProperty("--colour", `var(${COLOURS[i % COLOURS.length]!})`);
  return node;
}

const label = (name: string): string =>
  name
    .replace(/^style_/, "")
    .replace(/_share$/, "")
    .replaceAll("_", " ");
const percent = (share: number): string => `${number(share * 100, share < 0.0995 ? 1 : 0)} %`;
