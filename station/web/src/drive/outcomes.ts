// What the car's outcomes of a command mean for a driver.

import { LOST, REFUSALS, UNTIMELY } from "../base/contract";
import { capital } from "../base/format";

/** Outcomes that a wrong clock causes. */
export const untimely: ReadonlySet<string> = new Set(UNTIMELY);

/** Outcomes that end a session for good. */
export const lost: ReadonlySet<string> = new Set(LOST);

const WORDS: Readonly<Record<string, string>> = {
  ...REFUSALS,
  stopped: "the car was stopped: no command came in time",
};

export function inWords(outcome: string): string {
  return capital(WORDS[outcome] ?? outcome.replaceAll("_", " ")).replaceAll("`", "");
}
