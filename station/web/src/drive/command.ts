// The commands of one hold of the stick, as `iort_contract.messages.commands` writes them.

import { DRIVE_LEASE_MS, DRIVE_MARGIN_MS, type DriveLimitsEntry, SCHEMA_VERSION } from "../base/contract";
import type { Motion } from "./stick";

export interface Command {
  readonly v: number;
  readonly session: string;
  readonly started_us: number;
  readonly seq: number;
  readonly sent_us: number;
  readonly valid_ms: number;
  readonly lease_ms: number;
  readonly message: Readonly<Record<string, unknown>>;
  readonly by: string;
  readonly takeover?: true;
  /** It ends the lease at once, so that others may drive. */
  readonly ends?: true;
  /** The number of the newest picture on the screen. */
  readonly frame?: number;
  readonly blind?: true;
}

/** One hold of the stick. */
export interface Session {
  readonly name: string;
  readonly started_us: number;
  readonly by: string;
}

/** The first of the names in characters that the contract takes; a car ignores a command with others. */
export function driverName(...names: readonly string[]): string {
  const printable = names.map((name) => name.replace(/[\p{C}\p{Z}]/gu, " ").trim());
  return printable.find((name) => name !== "") ?? "somebody";
}

/** How long a command holds the car at most. */
export const leaseOf = ({ lease_ms }: DriveLimitsEntry): number => Math.min(DRIVE_LEASE_MS, lease_ms);

export function commandOf(
  session: Session,
  limits: DriveLimitsEntry,
  {
    seq,
    sent_us,
    motion,
    takeover,
    ends,
    frame,
    blind,
  }: {
    readonly seq: number;
    readonly sent_us: number;
    readonly motion: Motion;
    readonly takeover: boolean;
    readonly ends: boolean;
    readonly frame: number | undefined;
    readonly blind: boolean;
  },
): Command {
  const lease_ms = Math.max(1, leaseOf(limits) - DRIVE_MARGIN_MS);
  return {
    v: SCHEMA_VERSION,
    session: session.name,
    started_us: session.started_us,
    seq,
    // The clock may have been set back by a little since the session began.
    sent_us: Math.max(sent_us, session.started_us),
    valid_ms: lease_ms,
    lease_ms,
    message: messageOf(limits, motion),
    by: session.by,
    ...(takeover ? { takeover } : {}),
    ...(ends ? { ends } : {}),
    ...(frame === undefined ? {} : { frame }),
    ...(blind ? { blind } : {}),
  };
}

/** The ROS message with the two fields that the stick drives. */
function messageOf(
  { speed, steering }: DriveLimitsEntry,
  { speed_mps, steering_rad }: Motion,
): Record<string, unknown> {
  const message: Record<string, unknown> = {};
  for (const [path, value] of [
    [speed, speed_mps],
    [steering, steering_rad],
  ] as const) {
    const names = path.split(".");
    const last = names.pop()!;
    let inner = message;
    for (const name of names) inner = (inner[name] ??= {}) as Record<string, unknown>;
    inner[last] = value;
  }
  return message;
}
