"""List prices and default quotas with their date, as the cost model reads them.

They are public list prices in US dollars for `REGION`, without tax, free tier, volume tiers and discounts,
copied by hand from the pages below. `iort cost --refresh` reads AWS' own list instead (price_list.py).
"""

from __future__ import annotations

from typing import NamedTuple

AS_OF = "2025-06-01"
REGION = "eu-west-1"
MONTH_HOURS = 730.0
MONTH_DAYS = MONTH_HOURS / 24


class Price(NamedTuple):
    """``usd`` for ``per`` of ``unit``, from the pricing page ``page``.

    ``seen`` names a second source of the number after `AS_OF`, with its date. It is empty for most prices,
    since the pages load a region's prices by a script.
    """

    usd: float
    per: float
    unit: str
    page: str
    seen: str = ""

    @property
    def each(self) -> float:
        """Dollars for one unit."""
        return self.usd / self.per


_IOT = "https://aws.amazon.com/iot-core/pricing/"
_DEFENDER = "https://aws.amazon.com/iot-device-defender/pricing/"
_DYNAMODB = "https://aws.amazon.com/dynamodb/pricing/on-demand/"
_LAMBDA = "https://aws.amazon.com/lambda/pricing/"
_STATES = "https://aws.amazon.com/step-functions/pricing/"
_S3 = "https://aws.amazon.com/s3/pricing/"
_EVENTS = "https://aws.amazon.com/eventbridge/pricing/"
_CLOUDWATCH = "https://aws.amazon.com/cloudwatch/pricing/"
_SQS = "https://aws.amazon.com/sqs/pricing/"
_KMS = "https://aws.amazon.com/kms/pricing/"
_PUBNUB = "https://www.pubnub.com/docs/general/resources/pricing"

_PAGE = "the page, undated copy"
_IRELAND_EXAMPLE = "the page's example for Europe (Ireland), as read 2026-09-20"
_ARTILLERY = "artillery 2.0.28, platform/aws-lambda/prices.js: every region but five, which are not Ireland"
_KMS_COPY = "the page as copied 2019-10-30"

PRICES = {
    "connection": Price(0.08, 1e6, "minute connected", _IOT, _IRELAND_EXAMPLE),
    "message": Price(1.00, 1e6, "message of up to 5 KB", _IOT, _IRELAND_EXAMPLE),
    "rule": Price(0.15, 1e6, "rule triggered, up to 5 KB", _IOT),
    "action": Price(0.15, 1e6, "action executed, up to 5 KB", _IOT),
    "shadow": Price(1.25, 1e6, "shadow operation, up to 1 KB", _IOT),
    "audit": Price(1.10, 1000, "robot a month", _DEFENDER, "the page's example, as read 2026-09-20"),
    # us-east-1: 0.625 and 0.125 since November 2024 (airbyte.com, 2025-07-21), the same ratio as of storage.
    "write": Price(0.705, 1e6, "write request unit, up to 1 KB", _DYNAMODB),
    "read": Price(0.141, 1e6, "read request unit, up to 4 KB", _DYNAMODB),
    "storage": Price(0.283, 1, "GB-month", _DYNAMODB),
    "recovery": Price(0.226, 1, "GB-month recoverable to a point in time", _DYNAMODB),
    "invocation": Price(0.20, 1e6, "invocation", _LAMBDA),
    "compute_arm": Price(0.0000133334, 1, "GB-second, Arm", _LAMBDA, _ARTILLERY),
    "compute_x86": Price(0.0000166667, 1, "GB-second, x86", _LAMBDA, _ARTILLERY),
    "transition": Price(0.025, 1000, "state transition", _STATES, "the page's table, Europe (Ireland)"),
    "express_request": Price(1.00, 1e6, "request of an express workflow", _STATES),
    "express_duration": Price(0.00001667, 1, "GB-second of an express workflow", _STATES),
    "s3_standard": Price(0.023, 1, "GB-month in S3 Standard", _S3),
    "s3_instant": Price(0.005, 1, "GB-month in S3 Glacier Instant Retrieval", _S3),
    "s3_instant_read": Price(0.03, 1, "GB read from S3 Glacier Instant Retrieval", _S3),
    "s3_put": Price(0.005, 1000, "PUT, COPY, POST or LIST", _S3),
    "s3_get": Price(0.0004, 1000, "GET or HEAD", _S3),
    "s3_move": Price(0.02, 1000, "object moved to S3 Glacier Instant Retrieval", _S3),
    "schedule": Price(1.00, 1e6, "scheduled call", _EVENTS),
    "logs": Price(0.57, 1, "GB of log lines", _CLOUDWATCH),
    "metric": Price(0.30, 1, "metric a month", _CLOUDWATCH, "signoz.io, 2026-02-15"),
    "metric_request": Price(0.01, 1000, "metric requested by GetMetricData", _CLOUDWATCH),
    "alarm": Price(0.10, 1, "alarm a month", _CLOUDWATCH),
    "insights_alarm": Price(0.10, 1, "metric a month that a Metrics Insights alarm analyses", _CLOUDWATCH),
    "dashboard": Price(3.00, 1, "dashboard a month", _CLOUDWATCH, "factualminds.com, 2026-06-13"),
    "queue_request": Price(0.40, 1e6, "request", _SQS),
    "key": Price(1.00, 1, "key a month", _KMS, _KMS_COPY),
    "key_request": Price(0.03, 1e4, "request", _KMS, _KMS_COPY),
    "pubnub_publish": Price(0.000123, 1, "replicated transaction, up to 2 KB", _PUBNUB, _PAGE),
    "pubnub_receive": Price(0.000033, 1, "edge transaction, up to 2 KB", _PUBNUB, _PAGE),
}

# PubNub's plans by monthly active users: (users up to, dollars a month). Each viewer is a user, and Lambda 1
# is one; robots do not connect to PubNub. Fair use limits the messages, and the free plan is for development
# only. Source: https://www.pubnub.com/pricing/, without a second source since AS_OF.
PUBNUB_MAU_PLANS = ((1_000, 98.0), (5_000, 370.0), (10_000, 550.0), (25_000, 1_130.0))


class Quota(NamedTuple):
    """A default quota of an account in `REGION`; AWS raises ``adjustable`` ones on request.

    ``seen`` is as in `Price`. A new account may have lower quotas, such as of Lambda's executions.
    """

    value: float
    unit: str
    adjustable: bool
    page: str
    seen: str = ""


_IOT_QUOTAS = "https://docs.aws.amazon.com/general/latest/gr/iot-core.html"
_DYNAMODB_QUOTAS = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/ServiceQuotas.html"
_PARTITIONS = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/bp-partition-key-design.html"
_LAMBDA_QUOTAS = "https://docs.aws.amazon.com/lambda/latest/dg/gettingstarted-limits.html"
_RAINMAKER = "docs.espressif.com, specs/limits of RainMaker Neo, undated copy"
_SCALING = "docs.aws.amazon.com/lambda/latest/dg/services-sqs-scaling.html, undated copy"

QUOTAS = {
    "IoT Core: connections": Quota(500_000, "connections", True, _IOT_QUOTAS, _RAINMAKER),
    # The lower of two: AWS' pages of 2019 to 2023 say 500 a second, later ones 3,000 in most regions. Service
    # Quotas shows an account's own.
    "IoT Core: connects in a minute after an outage": Quota(
        500 * 60, "connects", True, _IOT_QUOTAS, "the page in two copies, undated: 500 and 3,000 a second"
    ),
    "IoT Core: subscriptions": Quota(500_000, "subscriptions", True, _IOT_QUOTAS),
    "IoT Core: publishes in": Quota(20_000, "1/s", True, _IOT_QUOTAS),
    "IoT Core: rule evaluations": Quota(20_000, "1/s", True, _IOT_QUOTAS),
    "IoT Core: publishes of one connection": Quota(
        100, "1/s", False, _IOT_QUOTAS, "repost.aws, question QUshJCmEV8SOSkAJ00SWfQ4Q, undated copy"
    ),
    "IoT Core: connects of one client id": Quota(1, "1/s", False, _IOT_QUOTAS, _PAGE),
    "DynamoDB: writes to table telemetry": Quota(40_000, "units/s", True, _DYNAMODB_QUOTAS, _PAGE),
    "DynamoDB: writes to table summary": Quota(40_000, "units/s", True, _DYNAMODB_QUOTAS, _PAGE),
    "DynamoDB: writes to one partition": Quota(1_000, "units/s", False, _PARTITIONS),
    "Lambda: concurrent executions": Quota(1_000, "executions", True, _LAMBDA_QUOTAS, _SCALING),
}
