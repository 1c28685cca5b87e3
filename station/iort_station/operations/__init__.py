"""Whether everything arrived and why not: audit, quarantine, replay, traces, CloudWatch."""
