"""Whether everything arrived, and how late: audit, the agents' accounts, samples counted, delays."""
