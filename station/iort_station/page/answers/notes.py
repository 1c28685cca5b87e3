"""People's notes about robots for the live page: read, written and deleted as `iort note` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from iort_contract.messages.analysis.insights import NotesAnswer
from iort_contract.messages.page import Answer
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.data.analysis import notes as stored
from iort_station.operations.monitoring.alarms import user
from iort_station.page.answers.parameters import text, whole

_NOTES = 200


def answers(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """The answer ``notes``."""
    return {"notes": lambda asked: listed(cloud, asked)}


def actions(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """What writes and deletes notes, by its name."""
    return {
        "note": lambda asked: write(cloud, asked),
        "delete_note": lambda asked: remove(cloud, asked),
    }


def listed(cloud: Cloud, asked: Mapping[str, str]) -> NotesAnswer:
    """The newest notes about ``robot``, or about the fleet; those from ``from_us`` to ``to_us``, if given."""
    robot = check_robot(asked["robot"]) if asked.get("robot") else None
    start_us, end_us = (
        whole(asked, name, 0, 2**53) if name in asked else None for name in ("from_us", "to_us")
    )
    found = stored.notes(cloud, robot, start_us, end_us, most=_NOTES)
    return {
        "notes": [
            {"id": one.id, "robot": one.robot, "t_us": one.t_us, "text": one.text, "by": one.by}
            for one in found
        ]
    }


def write(cloud: Cloud, asked: Mapping[str, str]) -> NotesAnswer:
    """Write a note with ``text`` about ``robot`` at ``t_us``, or about now."""
    robot = text(asked, "robot")
    t_us = whole(asked, "t_us", 0, 2**53) if "t_us" in asked else None
    stored.write(cloud, robot, text(asked, "text"), by=user(), t_us=t_us)
    return listed(cloud, {"robot": robot})


def remove(cloud: Cloud, asked: Mapping[str, str]) -> NotesAnswer:
    """Delete the note ``id`` of ``robot``."""
    robot = text(asked, "robot")
    stored.remove(cloud, robot, text(asked, "id"))
    return listed(cloud, {"robot": robot})
