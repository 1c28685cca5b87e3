"""Tables 6.1 to 6.3: the abilities of each service, each tried in this run.

The thesis took its answers from documentation and use. Here a probe tries each ability on the deployed
stacks. The report has the thesis' entry on the same point beside each answer, then its tables.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from bench import probes as dynamodb
from bench import probes as functions
from bench import probes as iot_core
from bench import probes as watching
from bench import thesis
from bench.probes import AbilityMissingError, ProbeFixture
from bench.report import Section
from bench.sections import Declared
from bench.thesis import UNSAID, said
from testkit.command import Table
from testkit.target import Say, Target

_IOT_CORE, _DYNAMODB, _LAMBDA, _PUBNUB, _CLOUDWATCH = "IoT Core", "DynamoDB", "Lambda", "PubNub", "CloudWatch"
# The thesis' entry on the point of an ability.
_PATTERN, _PROTOCOL = said(thesis.AWS_IOT, "pattern"), said(thesis.AWS_IOT, "protocol")
_COMPUTE, _NO_STORAGE = said(thesis.AWS_IOT, "compute"), said(thesis.AWS_IOT, "storage")
_STORAGE = said(thesis.DYNAMODB, "storage")
_STREAMS = f"Lambda's {said(thesis.LAMBDA, 'protocol')}"
_MONITORING = said(thesis.CLOUDWATCH, "monitoring")
_MANY, _ELASTIC = said(thesis.AWS_IOT, "concurrency"), said(thesis.DYNAMODB, "elasticity")
_WRITERS = f"{dynamodb.WRITERS} writers at once, nothing throttled"


class Probe(NamedTuple):
    """One cell: ``ask`` tries the ability and returns what it saw, or raises."""

    service: str
    ability: str
    thesis: str
    ask: Callable[[ProbeFixture], str]


# The cells of each table of the thesis.
PROBES: dict[thesis.Criteria, tuple[Probe, ...]] = {
    thesis.FUNCTIONALITY: (
        Probe(_IOT_CORE, "pushes a robot's message to another robot", _PATTERN, iot_core.robot_to_robot),
        Probe(_IOT_CORE, "transforms messages by rule", _COMPUTE, iot_core.rule_republishes),
        Probe(_IOT_CORE, "keeps a robot's newest state", _NO_STORAGE, iot_core.newest_state),
        Probe(_DYNAMODB, "stores and gives back the same", _STORAGE, dynamodb.stores),
        Probe(_DYNAMODB, "reads a range of time", _STORAGE, dynamodb.range_of_time),
        Probe(_DYNAMODB, "pushes what changed", _STREAMS, dynamodb.stream_of_changes),
        Probe(_LAMBDA, "computes on a message", said(thesis.LAMBDA, "compute"), functions.computes),
        Probe(_PUBNUB, "pushes to a dashboard", UNSAID, watching.live_sample),
        Probe(_CLOUDWATCH, "stores metrics and gives statistics", _MONITORING, watching.metrics),
        Probe(_CLOUDWATCH, "stores what functions log", _MONITORING, watching.logs),
        Probe(_CLOUDWATCH, "holds dashboards", _MONITORING, watching.dashboards),
    ),
    thesis.INTEROPERABILITY: (
        Probe(_IOT_CORE, "speaks MQTT 3.1.1 with any client", _PROTOCOL, iot_core.any_mqtt_client),
        Probe(_IOT_CORE, "takes messages over HTTPS", _PROTOCOL, iot_core.messages_over_https),
        Probe(_IOT_CORE, "rule into DynamoDB", _PROTOCOL, iot_core.rule_to_table),
        Probe(_IOT_CORE, "rule into Lambda and back", _PROTOCOL, iot_core.rule_to_function),
        Probe(_IOT_CORE, "rule republishes", _PATTERN, iot_core.rule_republishes),
        Probe(_IOT_CORE, "what a rule cannot store goes to a queue", UNSAID, iot_core.what_fails_is_kept),
        Probe(_DYNAMODB, "stream into Lambda into another table", _STREAMS, dynamodb.stream_of_changes),
        Probe(_LAMBDA, "into PubNub", said(thesis.LAMBDA, "pattern"), watching.live_sample),
    ),
    thesis.SCALABILITY: (
        Probe(_IOT_CORE, f"{iot_core.CLIENTS} connections at once", _MANY, iot_core.many_connections),
        Probe(_DYNAMODB, _WRITERS, said(thesis.DYNAMODB, "concurrency"), dynamodb.many_writers),
        Probe(_DYNAMODB, "paid by request, no capacity to set", _ELASTIC, dynamodb.on_demand),
        Probe(_LAMBDA, "in instances", said(thesis.LAMBDA, "concurrency"), functions.many_instances),
        Probe(_LAMBDA, "in size", said(thesis.LAMBDA, "elasticity"), functions.memory_size),
        Probe(_PUBNUB, f"{watching.LISTENERS} subscribers hear the same", UNSAID, watching.many_subscribers),
    ),
}


def run(target: Target, say: Say) -> Section:
    """Ask every probe."""
    section = Section("abilities", "Abilities (tables 6.1 to 6.3)")
    answers: dict[str, list[list[str]]] = {}
    failed = 0
    with ProbeFixture(target) as fixture:
        for criteria, probes in PROBES.items():
            title = f"{criteria.title.capitalize()} (table {criteria.number})"
            rows = answers[title] = []
            for probe in probes:
                say(f"{probe.service}: {probe.ability}")
                answer, seen = _answer(probe, fixture)
                failed += answer == "no"
                rows.append([probe.ability, probe.service, answer, probe.thesis, seen])
            head = ["ability", "service", "here", "thesis, 2018", "what the probe saw"]
            section.tables += [Table(title, head, rows), criteria.as_table()]
    count = sum(map(len, answers.values()))
    section.ratio("abilities that a probe did not find", failed, 0, unit=f"of {count}")
    section.notes.append(
        f"Beside each answer stands the entry of the {thesis.SOURCE} on the same point. Its rows on ROS and "
        "its columns modular and stateless say nothing that a probe of the cloud could try."
    )
    section.raw = {"answers": answers}
    return section


def _answer(probe: Probe, fixture: ProbeFixture) -> tuple[str, str]:
    try:
        return "yes", probe.ask(fixture)
    except AbilityMissingError as missing:
        return "no", str(missing)
    except Exception as error:  # noqa: BLE001 - any other behaviour of the service is an answer
        return "no", f"{type(error).__name__}: {error}"[:160]


SECTION = Declared("the abilities of each service, tried", run)
