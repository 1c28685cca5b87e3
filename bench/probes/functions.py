"""Probes of Lambda."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

from bench.probes.probe_fixture import AbilityMissingError, ProbeFixture, equal

INSTANCES = 4


def computes(fixture: ProbeFixture) -> str:
    """Lambda 2 answers an empty event."""
    function = fixture.cloud.output("processing", "SummarizeFunction")
    answer = fixture.cloud.client("lambda").invoke(FunctionName=function, Payload=b'{"Records": []}')
    equal(json.loads(answer["Payload"].read()), {"batchItemFailures": []})
    return "Lambda 2 answered an event"


def many_instances(fixture: ProbeFixture) -> str:
    """Simultaneous invocations run in several instances."""
    with ThreadPoolExecutor(INSTANCES) as pool:
        answers = list(pool.map(lambda _: fixture.who(0.5), range(INSTANCES)))
    instances = {answer["instance"] for answer in answers}
    if len(instances) < 2:
        raise AbilityMissingError(f"{INSTANCES} invocations at once ran in one instance")
    return f"{INSTANCES} invocations at once ran in {len(instances)} instances"


def memory_size(fixture: ProbeFixture) -> str:
    """The function sees its memory size change."""
    client = fixture.cloud.client("lambda")
    before = fixture.who(0)["memory_mb"]
    client.update_function_configuration(FunctionName=fixture.function, MemorySize=512)
    client.get_waiter("function_updated_v2").wait(FunctionName=fixture.function)
    after = fixture.who(0)["memory_mb"]
    equal((before, after), ("128", "512"))
    return f"the function saw {before} MB, and {after} MB after a change"
