"""SEARCH in GetMetricData.

AWS: finds the metrics that match, and answers each
  (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/search-expression-syntax.html).
ministack: answers that expressions are not implemented.
Test: tests/local/operations/test_metrics.py::test_a_search_finds_a_metric_of_any_action_type
Patch: none; only the form of SEARCH that our dashboards use is understood here
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

from ministack.services import cloudwatch

_SEARCH = re.compile(
    r"SEARCH\('\{(?P<schema>[^}]+)\} (?P<wanted>[^']+)', '(?P<stat>[^']+)', (?P<period>\d+)\)"
)


def install() -> None:
    """Close the gap in this process."""
    cloudwatch._get_metric_data = _searching(cloudwatch._get_metric_data)


def is_open() -> bool:
    """Search for a metric that nobody records."""
    search = "SEARCH('{AWS/IoT,RuleName} MetricName=\"Failure\"', 'Sum', 60)"
    request = {"MetricDataQueries": [{"Id": "a", "Expression": search}]}
    return b"not implemented" in cloudwatch._get_metric_data({}, request, is_cbor=False, is_json=True)[2]


def _searching(get_metric_data: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(get_metric_data)
    def answer(params: Any, request: dict[str, Any], *protocol: Any) -> Any:
        queries = [plain for query in request.get("MetricDataQueries", []) for plain in expand(query)]
        return get_metric_data(
            params, {**request, "MetricDataQueries": queries} if queries else request, *protocol
        )

    return answer


def expand(query: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A search gives one query per metric found, under the same id. Any other query stays as it is."""
    found = _SEARCH.search(query.get("Expression") or "")
    if not found:
        yield query
        return
    namespace, *names = found["schema"].split(",")
    wanted = dict(re.findall(r'(\w+)="([^"]*)"', found["wanted"]))
    metric = wanted.pop("MetricName")
    for key_namespace, key_metric, key_dimensions in list(cloudwatch._metrics.keys()):
        dimensions = dict(part.split("=", 1) for part in key_dimensions.split("|") if part)
        if (key_namespace, key_metric) != (namespace, metric) or dimensions.keys() != set(names):
            continue
        if wanted.items() <= dimensions.items():
            stat = {
                "Metric": {
                    "Namespace": namespace,
                    "MetricName": metric,
                    "Dimensions": [{"Name": k, "Value": v} for k, v in dimensions.items()],
                },
                "Period": int(found["period"]),
                "Stat": found["stat"],
            }
            label = query.get("Label") or dimensions[names[-1]]
            yield {
                **{k: v for k, v in query.items() if k != "Expression"},
                "MetricStat": stat,
                "Label": label,
            }
