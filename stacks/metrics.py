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
_FUNCTION_STATISTICS = {"Duration": "p95", "ConcurrentExecutions": "Maximum", "IteratorAge": "Maximum"}


def ours(metric: Metric, namespace: str) -> cloudwatch.Metric:
    """A metric that functions/ emits."""
    dimensions = {METRIC_DEPLOYMENT: namespace, METRIC_FUNCTION: metric.function}
    return _metric(METRIC_NAMESPACE, metric.name, dimensions, statistic=metric.statistic)


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


def rule(name: str, rule_name: str, *, label: str) -> cloudwatch.Metric:
    """A metric of a topic rule, by its physical name."""
    return _metric("AWS/IoT", name, {"RuleName": rule_name}, label=label)


def broker(name: str) -> cloudwatch.Metric:
    """A metric of the account's message broker."""
    return _metric("AWS/IoT", name, {"Protocol": "MQTT"})


def function(
    name: str, of: lambda_.IFunction | None = None, *, label: str | None = None
) -> cloudwatch.Metric:
    """A metric of a Lambda function; without one of all functions of the account, which has no dimensions."""
    dimensions = {"FunctionName": of.function_name} if of else {}
    return _metric(
        "AWS/Lambda", name, dimensions, label=label, statistic=_FUNCTION_STATISTICS.get(name, "Sum")
    )


def table(name: str, of: dynamodb.ITable, *, label: str | None = None) -> cloudwatch.Metric:
    """A metric of a DynamoDB table."""
    return _metric("AWS/DynamoDB", name, {"TableName": of.table_name}, label=label)


def of_the_account(namespace: str, name: str) -> cloudwatch.MathExpression:
    """The sum of a metric over all dimensions, by Metrics Insights, which an alarm may use; it may not use
    SEARCH."""
    return cloudwatch.MathExpression(
        expression=f'SELECT SUM({name}) FROM "{namespace}"',  # noqa: S608 - no database is asked
        using_metrics={},
        period=PERIOD,
    )


def machine(name: str, of: stepfunctions.IStateMachine) -> cloudwatch.Metric:
    """A metric of a state machine."""
    return _metric("AWS/States", name, {"StateMachineArn": of.state_machine_arn})


def waiting(of: sqs.IQueue, *, label: str | None = None) -> cloudwatch.Metric:
    """How many messages wait in a queue."""
    name = "ApproximateNumberOfMessagesVisible"
    return _metric("AWS/SQS", name, {"QueueName": of.queue_name}, label=label, statistic="Maximum")


def _metric(
    namespace: str,
    name: str,
    dimensions: dict[str, str],
    *,
    label: str | None = None,
    statistic: str = "Sum",
) -> cloudwatch.Metric:
    return cloudwatch.Metric(
        namespace=namespace,
        metric_name=name,
        dimensions_map=dimensions,
        statistic=statistic,
        period=PERIOD,
        label=label,
    )
