"""Answer: answers the questions of robots, or says why not. `functions.shared.questions` has the answers."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.metrics import emit
from functions.shared.questions import WORK, Bodies, RefusedError, Work, check_size
from functions.shared.queues import quarantined
from functions.shared.quotas import HOUR, Quota
from iort_contract.catalog.environments import AnswerEnvironment
from iort_contract.catalog.questions import QUESTIONS, Question
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import event_message, to_json
from iort_contract.messages.questions import (
    FAILED,
    INVALID,
    MALFORMED,
    MAX_INLINE_BYTES,
    OVER_QUOTA,
    TOO_LARGE,
    TOO_LATE,
    UNKNOWN,
    Answer,
    Ask,
    Content,
    Refusal,
    ask_id,
    decode_ask,
    encode_answer,
)
from iort_contract.tables import RECEIVED_MS, TOPIC
from iort_contract.topics import ANSWER, Topic, build_topic, check_robot, parse_topic

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)


class Desk(NamedTuple):
    """What an answer takes: the answers themselves, the robots' quotas, the bucket, the way to the robot."""

    work: Mapping[str, Work]
    quota_of: Callable[[Question], Quota]
    bodies: Bodies
    reply: Callable[[Topic, Answer], None]


def serve(event: Mapping[str, Any], desk: Desk, now_s: float) -> None:
    """Answer a rule's event. Any error is told to the robot, and raised: `ContractError` for a malformed
    question, which the quarantine keeps; `RuntimeError` where the answer itself is at fault."""
    topic = parse_topic(event[TOPIC])
    message = event_message(event)
    request_id = ask_id(message)
    try:
        ask = decode_ask(message)
    except ContractError as error:
        _refuse(topic, request_id, Refusal(MALFORMED, str(error)), desk)
        raise
    try:
        body = _answered(topic, ask, ask.deadline_us(event[RECEIVED_MS]), desk, now_s)
    except RefusedError as error:
        _refuse(topic, request_id, error.refusal, desk)
        return
    except ContractError as error:
        _refuse(topic, request_id, Refusal(FAILED, type(error).__name__), desk)
        raise RuntimeError(f"the answer cannot be made: {error}") from error
    except Exception as error:
        _refuse(topic, request_id, Refusal(FAILED, type(error).__name__), desk)
        raise
    desk.reply(topic, Answer(ask.id, body))
    emit("answer", QuestionsAnswered=1, AnswerMs=max(0.0, time.time() * 1000 - event[RECEIVED_MS]))


def operators(event: Mapping[str, Any]) -> dict[str, Any]:
    """Answer an operator's ``robot``, ``question`` and ``body``, without quota or deadline."""
    try:
        return {"body": WORK[_known(event["question"]).name](check_robot(event["robot"]), event["body"])}
    except (ContractError, RefusedError) as error:
        found = error.refusal if isinstance(error, RefusedError) else Refusal(INVALID, str(error))
        return {"refused": found.reason, "text": found.text}


def _known(name: str) -> Question:
    if name not in QUESTIONS:
        raise RefusedError(UNKNOWN, f"the question must be one of {', '.join(QUESTIONS)}, got {name}")
    return QUESTIONS[name]


def _answered(
    topic: Topic, ask: Ask, deadline_us: int, desk: Desk, now_s: float
) -> Mapping[str, Any] | Content:
    question, body = _known(topic.name), ask.body
    late_s = now_s - deadline_us / 1e6
    if late_s > 0:
        raise RefusedError(TOO_LATE, f"the deadline passed {late_s:.1f} s before the function began")
    if not isinstance(body, Content):
        check_size(_size(body), min(question.max_question_bytes, MAX_INLINE_BYTES))
    if not desk.quota_of(question).take(topic.robot, 1, now_s):
        raise RefusedError(OVER_QUOTA, f"{question.per_hour} an hour, and only of registered robots")
    if isinstance(body, Content):
        body = desk.bodies.read(topic.robot, question, body)
    found = desk.work[question.name](topic.robot, body)
    text, most = to_json(found), question.max_answer_bytes
    if len(text) > most:
        raise RefusedError(TOO_LARGE, f"the answer must have at most {most} bytes, got {len(text)}")
    return found if len(text) <= MAX_INLINE_BYTES else desk.bodies.write(topic.robot, ask.id, text)


def _size(body: Mapping[str, Any]) -> int:
    try:
        return len(to_json(body))
    except ContractError as error:
        # JSON has no infinity, but Python reads 1e999 as one.
        raise RefusedError(INVALID, str(error)) from error


def _refuse(topic: Topic, request_id: str | None, refusal: Refusal, desk: Desk) -> None:
    """Tell the robot why there is no answer. Without the question's id nobody can be told."""
    _log.warning("refused %s of %s: %s: %s", topic.name, topic.robot, *refusal)
    emit("answer", QuestionsRefused=1)
    if request_id is not None:
        desk.reply(topic, Answer(request_id, refusal))


def _reply(topic: Topic, answer: Answer) -> None:
    answers = build_topic(ANSWER, topic.robot, topic.name, topic.namespace)
    clients.iot_data().publish(topic=answers, qos=1, payload=encode_answer(answer))


def _quota_of(question: Question) -> Quota:
    return Quota(
        clients.dynamodb(),
        table=variables(AnswerEnvironment).robots_table,
        named=(question.hour_attribute, question.count_attribute),
        period=HOUR,
        most=question.per_hour,
    )


@quarantined
def _serve(event: Mapping[str, Any]) -> None:
    bodies = Bodies(clients.s3(), variables(AnswerEnvironment).files_bucket, clients.s3_for_robots())
    serve(event, Desk(WORK, _quota_of, bodies, _reply), time.time())


def handler(event: dict[str, Any], context: Any) -> dict[str, Any] | None:
    """Entry point of the rule ask, and of an operator."""
    if TOPIC not in event:
        return operators(event)
    _serve(event, context)
    return None
