"""The questions: a file a subject, a decorated function a question. They may use every package."""

from __future__ import annotations

from verify.question import Question
from verify.questions import (
    alarms,
    broker,
    certificates,
    dynamodb,
    files,
    functions,
    live,
    logs,
    payloads,
    provisioning,
    quarantine,
    rule_errors,
    rules,
    stream,
)

# In the order in which they are asked.
_FILES = (
    *(rules, payloads, rule_errors, broker, provisioning, certificates, stream),
    *(quarantine, dynamodb, functions, logs, files, live, alarms),
)
ALL = tuple(one for file in _FILES for one in vars(file).values() if isinstance(one, Question))
