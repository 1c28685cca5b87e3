"""The metrics of dashboards and alarms, AWS' and ours, each with its statistic.

AWS' names and dimensions are from each service's page "metrics and dimensions"; tests compare every used
metric with a table of those pages.
"""

from __future__ import annotations

from aws_cdk import Duration
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_sqs as sqs
from aws_cdk import aws_stepfunctions as stepfunctions

from iort_contract.catalog.metrics import (
    METRIC_DEPLOYMENT,
    METRIC_FUNCTION,
    METRIC_NAMESPACE,
    METRIC_ROBOT,
    Metric,
)

PERIOD = Duration.minutes(1)
WAITING = "ApproximateNumberOfMessagesVisible"
# The others are sums.
_STATISTICS = {
    "Duration": "p95",
    **dict.fromkeys(("ConcurrentExecutions", "IteratorAge", WAITING), "Maximum"),
}
# By the kind of a resource: namespace, dimension, and the attribute with its value.
_OF = {
    lambda_.Function: ("AWS/Lambda", "FunctionName", "function_name"),
    dynamodb.Table: ("AWS/DynamoDB", "TableName", "table_name"),
    sqs.Queue: ("AWS/SQS", "QueueName", "queue_name"),
    stepfunctions.StateMachine: ("AWS/States", "StateMachineArn", "state_machine_arn"),
}


def ours(metric: Metric, namespace: str) -> cloudwatch.Metric:
    """A metric that functions/ emits."""
    dimensions = {METRIC_DEPLOYMENT: namespace, METRIC_FUNCTION: metric.function}
    return aws(METRIC_NAMESPACE, metric.name, dimensions, statistic=metric.statistic)


def each_robot(metric: Metric, namespace: str) -> cloudwatch.MathExpression:
    """A metric of ours, one line for each robot: needs ``robot_metrics``."""
    schema = f"{METRIC_NAMESPACE},{METRIC_DEPLOYMENT},{METRIC_FUNCTION},{METRIC_ROBOT}"
    wanted = (
        f'MetricName="{metric.name}" {METRIC_DEPLOYMENT}="{namespace}" {METRIC_FUNCTION}="{metric.function}"'
    )
    return cloudwatch.MathExpression(
        expression=f"SEARCH('{{{schema}}} {wanted}', '{metric.statistic}', {PERIOD.to_seconds():.0f})",
        using_metrics={},
        period=PERIOD,
        label="",
    )


def aws(
    namespace: str,
    name: str,
    dimensions: dict[str, str] | None = None,
    *,
    label: str | None = None,
    statistic: str | None = None,
) -> cloudwatch.Metric:
    """A metric of a service; without dimensions of all the account."""
    return cloudwatch.Metric(
        namespace=namespace,
        metric_name=name,
        dimensions_map=dimensions or {},
        statistic=statistic or _STATISTICS.get(name, "Sum"),
        period=PERIOD,
        label=label,
    )


def of(
    resource: lambda_.Function | dynamodb.Table | sqs.Queue | stepfunctions.StateMachine,
    name: str,
    *,
    label: str | None = None,
) -> cloudwatch.Metric:
    """The service's metric of a resource."""
    namespace, dimension, attribute = _OF[type(resource)]
    return aws(namespace, name, {dimension: getattr(resource, attribute)}, label=label)


def of_the_account(namespace: str, name: str) -> cloudwatch.MathExpression:
    """The sum of a metric over all dimensions, by Metrics Insights, which an alarm may use; it may not use
    SEARCH."""
    return cloudwatch.MathExpression(
        expression=f'SELECT SUM({name}) FROM "{namespace}"',  # noqa: S608 - no database is asked
        using_metrics={},
        period=PERIOD,
    )
