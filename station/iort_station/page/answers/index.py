"""Every answer and action of the live page's server, by its name.

Each is a function of the request's parameters; its type is in `iort_contract.messages.page`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from iort_contract.messages.page import Answer
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.fleet import registry, tags
from iort_station.operations.monitoring import alarms, cloudwatch, cloudwatch_logs
from iort_station.page.answers import history, insights, laps, motion, notes, socket, viewing
from iort_station.page.answers.parameters import text, whole


def answers(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """Every answer, by its name."""
    return {
        "robots": lambda _asked: {"robots": registry.presence(cloud)},
        "tags": lambda _asked: {"tags": tags.listed(cloud)},
        "vehicles": lambda _asked: {"vehicles": registry.vehicles(cloud)},
        "streams": lambda asked: {"streams": inventory.streams_of(cloud, check_robot(text(asked, "robot")))},
        "runs": lambda asked: history.runs_of(cloud, asked),
        "history": lambda asked: history.history(cloud, asked),
        "dashboards": lambda _asked: {"dashboards": cloudwatch.dashboards(cloud)},
        "dashboard": lambda asked: cloudwatch.dashboard(
            cloud, text(asked, "name"), minutes=whole(asked, "minutes", 1, 14 * 24 * 60)
        ),
        "log": lambda asked: cloudwatch_logs.rows(
            cloud,
            text(asked, "name"),
            whole(asked, "widget", 0, 500),
            minutes=whole(asked, "minutes", 1, 14 * 24 * 60),
        ),
        "alarms": lambda _asked: {"alarms": alarms.alarms(cloud), "user": alarms.user()},
        "rejected": lambda _asked: alarms.rejected(cloud),
        "insights": lambda asked: insights.insights(cloud, asked),
        "analysis": lambda asked: insights.progress(cloud, asked),
        **laps.answers(cloud),
        **socket.answers(cloud),
        **notes.answers(cloud),
        **motion.answers(cloud),
    }


def actions(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Mapping[str, Any]]]:
    """What everybody who reaches the page may do, by its name."""
    return {
        "view": lambda asked: viewing.view(socket.prompt(cloud), asked),
        "acknowledge": lambda asked: alarms.acknowledge(
            cloud, text(asked, "alarm"), whole(asked, "since_ms", 0, 2**53) / 1000, asked.get("by", "")
        ),
    }
