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

from iort_contract.cloud import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRIC_ROBOT, METRICS

PERIOD = Duration.minutes(1)
# The worst car counts; a mean would hide it.
_STATISTICS = {"BatteryVolts": "Minimum", "TemperatureDegC": "Maximum", "BacklogBatches": "Maximum"}
_FUNCTION_STATISTICS = {"Duration": "p95", "ConcurrentExecutions": "Maximum", "IteratorAge": "Maximum"}


def ours(function: str, name: str, *, namespace: str, label: str | None = None) -> cloudwatch.Metric:
    """A metric that functions/ emits; KeyError if the contract does not know it."""
    if name not in METRICS[function]:
        raise KeyError(name)
    return _metric(
        METRIC_NAMESPACE,
        name,
        label=label,
        statistic=statistic(name),
        dimensions={METRIC_DEPLOYMENT: namespace, METRIC_FUNCTION: function},
    )


def each_robot(function: str, name: str, *, namespace: str) -> cloudwatch.MathExpression:
    """A metric of ours, one line for each robot: needs ``robot_metrics``."""
    if name not in METRICS[function]:
        raise KeyError(name)
    schema = f"{METRIC_NAMESPACE},{METRIC_DEPLOYMENT},{METRIC_FUNCTION},{METRIC_ROBOT}"
    wanted = f'MetricName="{name}" {METRIC_DEPLOYMENT}="{namespace}" {METRIC_FUNCTION}="{function}"'
    return cloudwatch.MathExpression(
        expression=f"SEARCH('{{{schema}}} {wanted}', '{statistic(name)}', {PERIOD.to_seconds():.0f})",
        using_metrics={},
        period=PERIOD,
        label="",
    )


def statistic(name: str) -> str:
    """The statistic of a minute of a metric of ours."""
    return _STATISTICS.get(name, "p95" if name.endswith("Ms") else "Sum")


def rule(name: str, rule_name: str, *, label: str) -> cloudwatch.Metric:
    """A metric of a topic rule, by its physical name."""
    return _metric("AWS/IoT", name, label=label, dimensions={"RuleName": rule_name})


def broker(name: str) -> cloudwatch.Metric:
    """A metric of the account's message broker."""
    return _metric("AWS/IoT", name, dimensions={"Protocol": "MQTT"})


def function(name: str, of: lambda_.IFunction, *, label: str | None = None) -> cloudwatch.Metric:
    """A metric of a Lambda function."""
    how = _FUNCTION_STATISTICS.get(name, "Sum")
    return _metric(
        "AWS/Lambda", name, label=label, statistic=how, dimensions={"FunctionName": of.function_name}
    )


def all_functions(name: str, *, label: str | None = None) -> cloudwatch.Metric:
    """A metric of all Lambda functions of the account, which has no dimensions."""
    how = _FUNCTION_STATISTICS.get(name, "Sum")
    return _metric("AWS/Lambda", name, label=label, statistic=how, dimensions={})


def table(name: str, of: dynamodb.ITable, *, label: str | None = None) -> cloudwatch.Metric:
    """A metric of a DynamoDB table."""
    return _metric("AWS/DynamoDB", name, label=label, dimensions={"TableName": of.table_name})


def of_the_account(namespace: str, name: str) -> cloudwatch.MathExpression:
    """The sum of a metric over all dimensions, by Metrics Insights, which an alarm may use; it may not use
    SEARCH."""
    return cloudwatch.MathExpression(
        expression=f'SELECT SUM({name}) FROM "{namespace}"',  # noqa: S608 - no database is asked
        using_metrics={},
        period=PERIOD,
    )


def waiting(of: sqs.IQueue, *, label: str | None = None) -> cloudwatch.Metric:
    """How many messages wait in a queue."""
    return _metric(
        "AWS/SQS",
        "ApproximateNumberOfMessagesVisible",
        label=label,
        statistic="Maximum",
        dimensions={"QueueName": of.queue_name},
    )


def _metric(
    namespace: str,
    name: str,
    *,
    dimensions: dict[str, str],
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
