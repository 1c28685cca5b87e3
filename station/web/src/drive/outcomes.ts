// What the car's outcomes of a command mean for a driver.

import { REFUSALS } from "../base/contract";
import { capital } from "../base/format";

/** Outcomes that a wrong clock causes. */
export const TOO_LATE: ReadonlySet<string> = new Set<keyof typeof REFUSALS>(["stale", "lease_over", "from_the_future"]);

const WORDS: Readonly<Record<string, string>> = { ...REFUSALS, stopped: "the car was stopped: no command came in time" };

export function inWords(outcome: string): string {
  return capital(WORDS[outcome] ?? outcome.replaceAll("_", " ")).replaceAll("`", "");
}
