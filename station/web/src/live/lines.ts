// The log lines of a car's agent: its stream `log` has one in each sample.

import type { Value } from "../base/contract";

export interface Line {
  /** By the car's clock, which is the same in the live lane and in the past. */
  readonly t_us: number;
  readonly level: string;
  readonly logger: string;
  readonly text: string;
  /** Lines that were too many to send, since the line before. */
  readonly leftOut: number;
}

export function lineOf(t_us: number, field: (name: string) => Value | undefined): Line | undefined {
  const [text, left] = [field("text"), field("left_out")];
  if (typeof text !== "string") return undefined;
  return {
    t_us,
    level: String(field("level") ?? ""),
    logger: String(field("logger") ?? ""),
    text,
    leftOut: typeof left === "number" ? left : 0,
  };
}
