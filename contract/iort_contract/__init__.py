"""The contract of every message: names, units, envelopes and limits.

The robot, the Lambda functions, the stacks and the operator's station all import this package, so it needs
only Python 3.8's standard library. Import a name from the module that defines it. Units are in the names
(``_us`` microseconds, ``_ms`` milliseconds, ``_s`` seconds since the Unix epoch) or in the catalogue.

Every check of input raises `iort_contract.limits.ContractError`, and no other error.
"""
