"""Mails to the subscribers of the topic of alarms."""

from __future__ import annotations

from functions.shared import clients

# "Publish", SNS API: "UTF-8 text with no line breaks or control characters, and less than 100 characters".
SUBJECT_CHARACTERS = 99


def subject_line(text: str) -> str:
    """The text as a subject that SNS takes; its end is left out where it is too long."""
    line = "".join(one if one.isprintable() else " " for one in text)
    return line if len(line) <= SUBJECT_CHARACTERS else f"{line[: SUBJECT_CHARACTERS - 3]}..."


def send(topic: str, subject: str, text: str) -> None:
    """Publish to the topic of that ARN."""
    clients.sns().publish(TopicArn=topic, Subject=subject_line(subject), Message=text)
