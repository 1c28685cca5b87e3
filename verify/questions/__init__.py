"""The questions: a room a subject, a decorated function a question. They may use every package."""

from __future__ import annotations

from verify.question import Question
from verify.questions.identity import certificates, people, policies, provisioning
from verify.questions.messages import broker, live, payloads, rule_errors, rules
from verify.questions.operations import alarms, analysis, functions, logs, schedules
from verify.questions.storage import archive, dynamodb, files, quarantine, stream

# In the order in which they are asked.
_FILES = (
    *(analysis, archive, schedules, rules, payloads, rule_errors, broker, provisioning, certificates),
    *(people, stream, quarantine, dynamodb, functions, logs, files, live, alarms, policies),
)
ALL = tuple(one for file in _FILES for one in vars(file).values() if isinstance(one, Question))
