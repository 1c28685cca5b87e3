"""The questions: a module a subject, a decorated function a question. They may use every package below."""

from __future__ import annotations

from verify.question import Question
from verify.questions import (
    alarms,
    analysis,
    archive,
    broker,
    files,
    functions,
    identity,
    live,
    people,
    provisioning,
    rules,
    stream,
)

# In the order in which they are asked: the first one wants a deployment that has no robot yet.
_FILES = (
    *(analysis, archive, rules, broker, provisioning, identity, people, stream, functions, files, live),
    alarms,
)
ALL = tuple(one for file in _FILES for one in vars(file).values() if isinstance(one, Question))
