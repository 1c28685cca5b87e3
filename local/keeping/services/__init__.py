"""The state of ministack's services, as documents in the ledger."""
