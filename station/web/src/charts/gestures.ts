// The wheel and two fingers on a chart: they pan it, and zoom it with Ctrl or by pinching.

import type { Range } from "../base/range";

export interface Gestures {
  readonly range: () => Range;
  /** Show another range; false if there is nothing to pan, and the page may scroll. `upright` is for an upright wheel. */
  readonly move: (to: Range, upright: boolean) => boolean;
}

const LINE_PX = 16;
const ZOOM_PER_PX = 0.004;
// Fingers closer than this pan.
const PINCH_PX = 24;

export function gestures(over: HTMLElement, { range, move }: Gestures): void {
  over.addEventListener(
    "wheel",
    (event) => {
      const [from, to] = range();
      const scale = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? LINE_PX : 1;
      const width = Math.max(1, over.clientWidth);
      const upright = Math.abs(event.deltaY) > Math.abs(event.deltaX);
      const delta = (upright ? event.deltaY : event.deltaX) * scale;
      if (event.ctrlKey) {
        const at = from + (to - from) * (event.offsetX / width);
        const share = Math.exp(delta * ZOOM_PER_PX);
        move([at - (at - from) * share, at + (to - at) * share], false);
        event.preventDefault();
        return;
      }
      const by = (delta / width) * (to - from);
      if (move([from + by, to + by], upright && !event.shiftKey)) event.preventDefault();
    },
    { passive: false },
  );
  fingers(over, range, (to) => move(to, false));
}

/** Two fingers hold the times that they touched. */
function fingers(over: HTMLElement, range: () => Range, move: (to: Range) => void): void {
  const touching = new Map<number, number>();
  let held: readonly [number, number] | undefined;
  const x = (event: PointerEvent): number => event.clientX - over.getBoundingClientRect().left;
  const places = (): [number, number] => [...touching.values()].sort((a, b) => a - b) as [number, number];
  const hold = (): void => {
    held = undefined;
    if (touching.size !== 2) return;
    const [from, to] = range();
    const [left, right] = places().map((px) => from + ((to - from) * px) / Math.max(1, over.clientWidth)) as [
      number,
      number,
    ];
    held = [left, right];
  };
  over.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "touch") return;
    touching.set(event.pointerId, x(event));
    hold();
  });
  over.addEventListener("pointermove", (event) => {
    if (!touching.has(event.pointerId)) return;
    touching.set(event.pointerId, x(event));
    if (!held) return;
    const [left, right] = places();
    const [from, to] = range();
    const width = Math.max(1, over.clientWidth);
    const apart = right - left > PINCH_PX;
    const each = apart ? (held[1] - held[0]) / (right - left) : (to - from) / width;
    const start = (held[0] + held[1]) / 2 - ((left + right) / 2) * each;
    move([start, start + width * each]);
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"] as const) {
    over.addEventListener(end, (event) => {
      if (touching.delete(event.pointerId)) hold();
    });
  }
}
