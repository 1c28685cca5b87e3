// The cloud's clock as this page knows it. A command's age is judged by the cloud's time, and this computer's clock
// may be wrong. Each message from the car says that the cloud's clock was not behind its time when it arrived here;
// each answered command, that it was not ahead of the answer's when the command left. The truth lies in between.

import { DRIVE_CLOCK_KEPT_MS } from "../base/contract";

interface Bound {
  readonly at_ms: number;
  readonly offset_ms: number;
}

export class CloudClock {
  private lows: Bound[] = [];
  private highs: Bound[] = [];

  /** A message that left at the cloud's time `sent_ms` arrived here now. */
  heard(sent_ms: number, now_ms: number): void {
    this.lows = kept(this.lows, { at_ms: now_ms, offset_ms: sent_ms - now_ms }, (one, other) => one >= other);
  }

  /** The car had a command, which left here at `left_ms`, at the cloud's time `taken_ms`. */
  answered(left_ms: number, taken_ms: number): void {
    this.highs = kept(
      this.highs,
      { at_ms: left_ms, offset_ms: taken_ms - left_ms },
      (one, other) => one <= other,
    );
  }

  /** The cloud's time less this computer's; undefined before the first message. Without an answer it is the least
   *  that it can be: a command seems older than it is, and its lease ends too early, never too late. */
  get offset_ms(): number | undefined {
    const low = this.lows[0]?.offset_ms;
    const high = this.highs[0]?.offset_ms;
    if (low === undefined) return undefined;
    // They contradict each other once one of the clocks was set, or this computer slept.
    return high === undefined || high < low ? low : (low + high) / 2;
  }
}

/** The bounds of the last minute, the tightest first: a newer one replaces those that it betters. */
function kept(
  bounds: readonly Bound[],
  bound: Bound,
  betters: (one: number, other: number) => boolean,
): Bound[] {
  const young = bounds.filter(({ at_ms }) => bound.at_ms - at_ms < DRIVE_CLOCK_KEPT_MS);
  return [...young.filter(({ offset_ms }) => !betters(bound.offset_ms, offset_ms)), bound];
}
