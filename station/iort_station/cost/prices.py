"""List prices and default quotas with their date, in US dollars for `REGION`, without tax and discounts.

They are copied by hand from the services' pages: https://aws.amazon.com/SERVICE/pricing/, and
https://www.pubnub.com/docs/general/resources/pricing.
"""

from __future__ import annotations

from typing import NamedTuple

AS_OF, REGION = "2025-06-01", "eu-west-1"
MONTH_HOURS = 730.0
MONTH_DAYS = MONTH_HOURS / 24


class Price(NamedTuple):
    """``usd`` for ``per`` of ``unit``."""

    service: str
    usd: float
    per: float
    unit: str

    @property
    def each(self) -> float:
        """Dollars for one unit."""
        return self.usd / self.per


# "Confirmed" names a second source of the number after `AS_OF`. Most prices have none, since the pages load a
# region's prices by a script.
PRICES = {
    # Confirmed: connection and message, by the page's example for Europe (Ireland), as read 2026-09-20.
    "connection": Price("IoT Core", 0.08, 1e6, "minute connected"),
    "message": Price("IoT Core", 1.00, 1e6, "message of up to 5 KB"),
    "rule": Price("IoT Core", 0.15, 1e6, "rule triggered, up to 5 KB"),
    "action": Price("IoT Core", 0.15, 1e6, "action executed, up to 5 KB"),
    "shadow": Price("IoT Core", 1.25, 1e6, "shadow operation, up to 1 KB"),
    # us-east-1: 0.625 and 0.125 since November 2024 (airbyte.com, 2025-07-21), the same ratio as of storage.
    "write": Price("DynamoDB", 0.705, 1e6, "write request unit, up to 1 KB"),
    "read": Price("DynamoDB", 0.141, 1e6, "read request unit, up to 4 KB"),
    "storage": Price("DynamoDB", 0.283, 1, "GB-month"),
    "recovery": Price("DynamoDB", 0.226, 1, "GB-month recoverable to a point in time"),
    # Confirmed: compute, by artillery 2.0.28, platform/aws-lambda/prices.js: every region but five, which are
    # not Ireland.
    "invocation": Price("Lambda", 0.20, 1e6, "invocation"),
    "compute_arm": Price("Lambda", 0.0000133334, 1, "GB-second, Arm"),
    "compute_x86": Price("Lambda", 0.0000166667, 1, "GB-second, x86"),
    # Confirmed: transition, by the page's table for Europe (Ireland).
    "transition": Price("Step Functions", 0.025, 1000, "state transition"),
    "express_request": Price("Step Functions", 1.00, 1e6, "request of an express workflow"),
    "express_duration": Price("Step Functions", 0.00001667, 1, "GB-second of an express workflow"),
    "s3_standard": Price("S3", 0.023, 1, "GB-month in S3 Standard"),
    "s3_instant": Price("S3", 0.005, 1, "GB-month in S3 Glacier Instant Retrieval"),
    "s3_instant_read": Price("S3", 0.03, 1, "GB read from S3 Glacier Instant Retrieval"),
    "s3_put": Price("S3", 0.005, 1000, "PUT, COPY, POST or LIST"),
    "s3_get": Price("S3", 0.0004, 1000, "GET or HEAD"),
    "s3_move": Price("S3", 0.02, 1000, "object moved to S3 Glacier Instant Retrieval"),
    "schedule": Price("EventBridge", 1.00, 1e6, "scheduled call"),
    # Confirmed: metric, by signoz.io, 2026-02-15; dashboard, by factualminds.com, 2026-06-13.
    "logs": Price("CloudWatch", 0.57, 1, "GB of log lines"),
    "metric": Price("CloudWatch", 0.30, 1, "metric a month"),
    "metric_request": Price("CloudWatch", 0.01, 1000, "metric requested by GetMetricData"),
    "alarm": Price("CloudWatch", 0.10, 1, "alarm a month"),
    "insights_alarm": Price("CloudWatch", 0.10, 1, "metric a month that a Metrics Insights alarm analyses"),
    "dashboard": Price("CloudWatch", 3.00, 1, "dashboard a month"),
    # Confirmed: both by the page's examples of US East, as copied 2026-10-07.
    "channel": Price("Kinesis Video Streams", 0.03, 1, "signalling channel a month in which it is used"),
    "relay_minute": Price("Kinesis Video Streams", 0.12, 1000, "minute of a relay (TURN)"),
    "transfer_out": Price("data transfer", 0.09, 1, "GB to the internet, of the first 10 TB a month"),
    "queue_request": Price("SQS", 0.40, 1e6, "request"),
    # Confirmed by the page as copied 2019-10-30.
    "key": Price("KMS", 1.00, 1, "key a month"),
    "key_request": Price("KMS", 0.03, 1e4, "request"),
    # Confirmed by an undated copy of the page.
    "pubnub_publish": Price("PubNub", 0.000123, 1, "replicated transaction, up to 2 KB"),
    "pubnub_receive": Price("PubNub", 0.000033, 1, "edge transaction, up to 2 KB"),
}

# PubNub's plans by monthly active users: (users up to, dollars a month). Each viewer is a user, and Lambda 1
# is one; robots do not connect to PubNub. Fair use limits the messages, and the free plan is for development
# only. Source: https://www.pubnub.com/pricing/, without a second source since AS_OF.
PUBNUB_MAU_PLANS = ((1_000, 98.0), (5_000, 370.0), (10_000, 550.0), (25_000, 1_130.0))
