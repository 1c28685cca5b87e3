// How old a picture is: the car's clock as this page knows it, and which picture is on the screen.

import { ECHO_KEPT_MS } from "../base/contract";
import type { Mark } from "./messages";

interface Word {
  readonly at_ms: number;
  readonly offset_ms: number;
  readonly cost_ms: number;
  readonly within_ms: number;
}

// Two clocks drift by less while a word is believed.
export const DRIFT_MS = 5;

/** The car's clock less this page's, by the word of the car that was the least time on its way lately. */
export class RobotClock {
  private words: Word[] = [];

  /** `cost_ms` compares words: the round trip of a question, or how late a message came by both clocks. The truth is
   *  within `within_ms` of the offset. */
  heard(offset_ms: number, cost_ms: number, at_ms: number, within_ms = Infinity): void {
    // A newer word replaces those that it betters, and those that it contradicts: a clock was set.
    this.words = this.words.filter(
      (word) =>
        at_ms - word.at_ms < ECHO_KEPT_MS &&
        word.cost_ms < cost_ms &&
        Math.abs(word.offset_ms - offset_ms) <= word.within_ms + within_ms + DRIFT_MS,
    );
    this.words.push({ at_ms, offset_ms, cost_ms, within_ms });
  }

  /** Undefined before the first word. */
  get offset_ms(): number | undefined {
    return this.words[0]?.offset_ms;
  }

  /** The most that the truth can be above the offset. */
  get within_ms(): number | undefined {
    return this.words[0]?.within_ms;
  }

  /** How long the best word's way took. */
  get cost_ms(): number | undefined {
    return this.words[0]?.cost_ms;
  }
}

// Some seconds at any rate of pictures.
const KEPT = 512;

/** The marks of a WebRTC session by their RTP timestamps: a picture may come before its mark. */
export class Marks {
  /** The newest picture that was on the screen; undefined before its mark. */
  shown: Mark | undefined;
  private readonly marks = new Map<number, Mark>();
  private rtp: number | undefined;

  /** Returns whether another picture is known to be on the screen. */
  heard(marks: readonly Mark[]): boolean {
    for (const mark of marks) this.marks.set(mark.rtp, mark);
    for (const rtp of this.marks.keys()) {
      if (this.marks.size <= KEPT) break;
      this.marks.delete(rtp);
    }
    return this.see();
  }

  /** The picture with this RTP timestamp is on the screen. */
  seen(rtp: number): boolean {
    this.rtp = rtp;
    return this.see();
  }

  private see(): boolean {
    const mark = this.rtp === undefined ? undefined : this.marks.get(this.rtp);
    if (!mark || mark === this.shown || (this.shown && mark.number <= this.shown.number)) return false;
    this.shown = mark;
    return true;
  }
}
