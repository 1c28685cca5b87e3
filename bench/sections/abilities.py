"""Tables 6.1 to 6.3: what each service can do, every answer by doing it in this run.

The thesis gave its answers from documentation and use; here a probe exercises each ability on the deployed
stacks, and what it saw stands beside. *Used* says that the thesis' system rested on the ability.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bench.probes import dynamodb, functions, iot_core, watching
from bench.probes.ground import Ground, No
from bench.result import Ratio, Section, Table
from bench.target import Say, Target

_IOT_CORE, _DYNAMODB, _LAMBDA, _PUBNUB, _CLOUDWATCH = "IoT Core", "DynamoDB", "Lambda", "PubNub", "CloudWatch"
# What the thesis said of it.
_USED, _UNSAID = "used", "-"
_FUNCTIONALITY = "Functionality (table 6.1)"
_INTEROPERABILITY = "Interoperability and composability (table 6.2)"
_SCALABILITY = "Scalability (table 6.3)"


@dataclass(frozen=True)
class Probe:
    """One cell: ``ask`` exercises the ability and says what it saw, or raises."""

    service: str
    ability: str
    thesis: str
    ask: Callable[[Ground], str]


# Every cell of the three tables.
PROBES = {
    _FUNCTIONALITY: (
        Probe(_IOT_CORE, "pushes a robot's message to another robot", _USED, iot_core.robot_to_robot),
        Probe(_IOT_CORE, "transforms messages by rule", _USED, iot_core.rule_republishes),
        Probe(_IOT_CORE, "keeps a robot's newest state", _UNSAID, iot_core.newest_state),
        Probe(_DYNAMODB, "stores and gives back the same", _USED, dynamodb.stores),
        Probe(_DYNAMODB, "reads a range of time", _USED, dynamodb.range_of_time),
        Probe(_DYNAMODB, "pushes what changed", _USED, dynamodb.stream_of_changes),
        Probe(_LAMBDA, "computes on a message", _USED, functions.computes),
        Probe(_PUBNUB, "pushes to a dashboard", _USED, watching.live_sample),
        Probe(_CLOUDWATCH, "stores metrics and gives statistics", _USED, watching.metrics),
        Probe(_CLOUDWATCH, "stores what functions log", _USED, watching.logs),
        Probe(_CLOUDWATCH, "holds dashboards", _USED, watching.dashboards),
    ),
    _INTEROPERABILITY: (
        Probe(_IOT_CORE, "speaks MQTT 3.1.1 with any client", _USED, iot_core.any_mqtt_client),
        Probe(_IOT_CORE, "takes messages over HTTPS", _UNSAID, iot_core.messages_over_https),
        Probe(_IOT_CORE, "rule into DynamoDB", _USED, iot_core.rule_to_table),
        Probe(_IOT_CORE, "rule into Lambda and back", _USED, iot_core.rule_to_function),
        Probe(_IOT_CORE, "rule republishes", _USED, iot_core.rule_republishes),
        Probe(_IOT_CORE, "what a rule cannot store goes to a queue", _UNSAID, iot_core.what_fails_is_kept),
        Probe(_DYNAMODB, "stream into Lambda into another table", _USED, dynamodb.stream_of_changes),
        Probe(_LAMBDA, "into PubNub", _USED, watching.live_sample),
    ),
    _SCALABILITY: (
        Probe(_IOT_CORE, f"{iot_core.CLIENTS} connections at once", _UNSAID, iot_core.many_connections),
        Probe(
            _DYNAMODB,
            f"{dynamodb.WRITERS} writers at once, nothing throttled",
            _UNSAID,
            dynamodb.many_writers,
        ),
        Probe(_DYNAMODB, "paid by request, no capacity to set", _UNSAID, dynamodb.on_demand),
        Probe(_LAMBDA, "in instances", _UNSAID, functions.many_instances),
        Probe(_LAMBDA, "in size", _UNSAID, functions.memory_size),
        Probe(_PUBNUB, f"{watching.LISTENERS} subscribers hear the same", _UNSAID, watching.many_subscribers),
    ),
}


def run(target: Target, say: Say) -> Section:
    """Ask every probe."""
    section = Section("abilities", "Abilities (tables 6.1 to 6.3)")
    answers: dict[str, list[list[str]]] = {title: [] for title in PROBES}
    failed = 0
    with Ground(target) as ground:
        for title, probes in PROBES.items():
            for probe in probes:
                say(f"{probe.service}: {probe.ability}")
                answer, seen = _answer(probe, ground)
                failed += answer == "no"
                answers[title].append([probe.ability, probe.service, answer, probe.thesis, seen])
    for title, rows in answers.items():
        section.tables.append(
            Table(title, ["ability", "service", "here", "thesis, 2018", "what the probe saw"], rows)
        )
    count = sum(map(len, answers.values()))
    section.ratios.append(Ratio("abilities that a probe did not find", failed, 0, f"of {count}"))
    section.raw = {"answers": answers}
    return section


def _answer(probe: Probe, ground: Ground) -> tuple[str, str]:
    try:
        return "yes", probe.ask(ground)
    except No as no:
        return "no", str(no)
    except Exception as error:  # noqa: BLE001 - whatever the service does instead is the answer
        return "no", f"{type(error).__name__}: {error}"[:160]
