"""The questions: a room a subject, a decorated function a question. They may use every package."""

from __future__ import annotations

from verify.question import Question
from verify.questions.identity import certificates, provisioning
from verify.questions.messages import broker, live, payloads, rule_errors, rules
from verify.questions.operations import alarms, functions, logs
from verify.questions.storage import dynamodb, files, quarantine, stream

# In the order in which they are asked.
_FILES = (
    *(rules, payloads, rule_errors, broker, provisioning, certificates, stream),
    *(quarantine, dynamodb, functions, logs, files, live, alarms),
)
ALL = tuple(one for file in _FILES for one in vars(file).values() if isinstance(one, Question))
