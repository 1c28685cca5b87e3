// What the car's outcomes of a command mean for a driver: `iort_contract.messages.driving`.

const WORDS: Readonly<Record<string, string>> = {
  stale: "The command came too late: is the network slow, or this computer's clock wrong?",
  lease_over: "The command came too late: is the network slow, or this computer's clock wrong?",
  from_the_future: "This computer's clock is ahead of the cloud's",
  driven_by_another: "Somebody else drives this car",
  emergency_stop: "The emergency stop is on",
  begin_again: "Let go, and begin again",
  clock_offset_unknown: "The car does not know the cloud's time yet, and moves without it for nobody",
  settings_unknown: "The car has not read its settings yet, and the emergency stop is one",
  guard_not_ready: "The car's guard, which stops it if its agent dies, is not ready",
  no_ros: "The car's ROS master is not reached",
  shutting_down: "The car's agent is ending",
  from_an_earlier_session: "A later session has driven this car: let go, and begin again",
  stopped: "The car was stopped: no command came in time",
};

/** Outcomes that a wrong clock causes. */
export const TOO_LATE: ReadonlySet<string> = new Set(["stale", "lease_over", "from_the_future"]);

export function inWords(outcome: string): string {
  return WORDS[outcome] ?? `The car refuses: ${outcome.replaceAll("_", " ")}`;
}
