// The windows of the live charts, and the marks of their time axis.

/** In seconds; the first is the one that is shown unless the viewer chooses. */
export const WINDOWS = [30, 10, 60, 300, 900, 1800] as const;

const STEPS_S: Readonly<Record<number, number>> = { 10: 5, 30: 10, 60: 20, 300: 60, 900: 300, 1800: 600 };

export function windowLabel(window_s: number): string {
  return window_s < 120 ? `${window_s} s` : `${window_s / 60} min`;
}

/** The marks, in seconds from the left edge. */
export function marks(window_s: number): number[] {
  const step = STEPS_S[window_s] ?? window_s;
  return Array.from({ length: window_s / step + 1 }, (_, i) => i * step);
}

/** −30 s, −20, −10, now. */
export function markLabels(window_s: number): string[] {
  const unit = window_s < 120 ? 1 : 60;
  return marks(window_s).map((mark, i) => {
    const ago = (window_s - mark) / unit;
    return ago === 0 ? "now" : `\u2212${ago}${i === 0 ? (unit === 1 ? " s" : " min") : ""}`;
  });
}
