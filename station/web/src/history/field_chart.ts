// A chart of one or several fields of a past, to which the viewer adds lines, and on which an alarm is set.

import type { Lines } from "../charts/lines_panel";
import { Chart, fieldList, lineOf, together } from "./chart";
import type { Touch } from "./panels";
import type { Past } from "./past";

/** Fields that share a chart stand in its key, one after another. */
const TOGETHER = "~";
/** As many as there are colours. */
const MOST_LINES = 6;

export const fieldsOf = (key: string): string[] => [...new Set(key.split(TOGETHER))].slice(0, MOST_LINES);

/** The chart of a key: `speed`, `pose/x`, or `speed~pose/x` on one axis of time. */
export function fieldChart(
  key: string,
  past: () => Past | undefined,
  touch: Touch,
  changed: (key: string) => void,
): Chart<Past> {
  const keys = fieldsOf(key);
  const title = keys.map((each) => past()?.label(each) ?? each).join(" · ");
  const single = keys.length === 1 ? keys[0]! : undefined;
  const chart = new Chart<Past>({
    title,
    touch,
    ...(single === undefined ? {} : { reading: single }),
    lines: (data) => linesOf(keys, data),
  });
  const offered = (): Map<string, (readonly [string, string])[]> => {
    const all = past()?.numeric() ?? new Map<string, readonly string[]>();
    return new Map(
      [...all].map(([stream, of]) => [
        stream,
        of.map((each) => [each, `${keys.includes(each) ? "✓ " : ""}${past()!.spec(each).label}`] as const),
      ]),
    );
  };
  const list = fieldList(`Lines of ${title}`, "+", offered, (field) => {
    const others = keys.filter((each) => each !== field);
    const next = others.length < keys.length ? others : [...keys, field];
    if (next.length > 0) changed(next.slice(0, MOST_LINES).join(TOGETHER));
  });
  chart.panel.aside.append(list);
  return chart;
}

function linesOf(keys: readonly string[], past: Past): Lines | undefined {
  const fields = keys.flatMap((key) => {
    const field = past.field(key);
    return field ? [{ ...field, key }] : [];
  });
  const [first] = fields;
  if (!first) return undefined;
  if (keys.length === 1) {
    const { x, columns, spec } = first;
    return { x, columns, hole: past.hole(first.stream), lines: [lineOf(spec, spec.label)] };
  }
  return {
    ...together(fields.map(({ x, columns }) => ({ x, y: columns[0] as readonly (number | null)[] }))),
    hole: Math.max(...fields.map(({ stream }) => past.hole(stream))),
    lines: fields.map(({ key, spec }) => lineOf(spec, past.label(key))),
  };
}
