// How the pictures come, as a line: their rate and bits, what was lost, the round trip.

import { milliseconds, number } from "../base/format";
import type { Counts } from "./peer";

interface Counted {
  readonly at_ms: number;
  readonly way: string;
  readonly counts: Counts;
}

export class Figures {
  private before: Counted | undefined;

  /** The line about what came since the last call, of a picture of this size; empty if there is nothing to compare. */
  line(way: string, counts: Counts, at_ms: number, width: number, height: number): string {
    const { before } = this;
    this.before = { at_ms, way, counts };
    if (!before || before.way !== way || at_ms <= before.at_ms) return "";
    const seconds = (at_ms - before.at_ms) / 1000;
    const since = (name: "bytes" | "pictures" | "packets" | "lost"): number =>
      Math.max(0, counts[name] - before.counts[name]);
    const packets = since("packets") + since("lost");
    return [
      `${width} × ${height}`,
      `${number(since("pictures") / seconds, 1)} pictures/s`,
      `${number((8 * since("bytes")) / 1000 / seconds, 0)} kbit/s`,
      ...(packets > 0 ? [`${number((100 * since("lost")) / packets, 1)} % lost`] : []),
      ...(counts.rtt_ms === undefined ? [] : [`round trip ${milliseconds(counts.rtt_ms)} ms`]),
    ].join(", ");
  }
}
