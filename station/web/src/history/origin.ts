// Says which part of an answer comes from the archive, and what it lacks.

import type { Archived, HistoryAnswer } from "../base/contract";
import { dayTime, number, when } from "../base/format";
import type { Range } from "../base/range";

/** A sentence, with a space before it; nothing if all comes from the table. */
/** What the answer lacks since it cannot be read. */
export function unread(answer: HistoryAnswer): string {
  return answer.refused > 0
    ? ` ${number(answer.refused)} stored items cannot be read; the first: ${answer.reason}.`
    : "";
}

export function fromArchive(archive: Archived | null, [start, end]: Range): string {
  if (archive === null) return "";
  const [from, to] = [Math.max(start, archive.from_us / 1e6), Math.min(end, archive.to_us / 1e6)];
  if (from <= start && to >= end) return " From the archive.";
  return ` From the archive: ${dayTime(from)} to ${when(to)}.`;
}
