"""What Lambda can do."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

from bench.probes.ground import Ground, No, equal

INSTANCES = 4


def computes(ground: Ground) -> str:
    """Lambda 2 answers an empty event."""
    function = ground.cloud.output("processing", "SummarizeFunction")
    answer = ground.cloud.client("lambda").invoke(FunctionName=function, Payload=b'{"Records": []}')
    equal(json.loads(answer["Payload"].read()), {"batchItemFailures": []})
    return "Lambda 2 answered an event"


def many_instances(ground: Ground) -> str:
    """Invocations at once say which instance they ran in."""
    with ThreadPoolExecutor(INSTANCES) as pool:
        answers = list(pool.map(lambda _: ground.who(0.5), range(INSTANCES)))
    instances = {answer["instance"] for answer in answers}
    if len(instances) < 2:
        raise No(f"{INSTANCES} invocations at once ran in one instance")
    return f"{INSTANCES} invocations at once ran in {len(instances)} instances"


def memory_size(ground: Ground) -> str:
    """The size before and after a change, as the function sees it."""
    client = ground.cloud.client("lambda")
    before = ground.who(0)["memory_mb"]
    client.update_function_configuration(FunctionName=ground.function, MemorySize=512)
    client.get_waiter("function_updated_v2").wait(FunctionName=ground.function)
    after = ground.who(0)["memory_mb"]
    equal((before, after), ("128", "512"))
    return f"the function saw {before} MB, and {after} MB after a change"
