"""What the design takes for granted and no program asks in half an hour."""

from __future__ import annotations

from verify.assumption import Assumption, Basis

_IOT = "https://docs.aws.amazon.com/iot/latest/developerguide"
_LAMBDA = "https://docs.aws.amazon.com/lambda/latest/dg"
_DYNAMODB = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide"


def _documented(name: str, assumed: str, source: str, *relied_on_by: str) -> Assumption:
    return Assumption(
        name=name, assumed=assumed, basis=Basis.DOCUMENTED, source=source, relied_on_by=relied_on_by
    )


def _assumed(name: str, assumed: str, *relied_on_by: str) -> Assumption:
    return Assumption(name=name, assumed=assumed, basis=Basis.ASSUMED, relied_on_by=relied_on_by)


UNASKED = (
    # An outage of Lambda cannot be ordered.
    _documented(
        "lambda.asynchronous",
        "A rule's invocation waits in a queue of Lambda's. A throttled one is tried again for up to six "
        "hours, a failed one as often as the function's settings say; then it goes to the destination for "
        "failures.",
        f"{_LAMBDA}/invocation-async-error-handling.html",
        "stacks/processing.py",
        "local/gaps.py",
    ),
    _documented(
        "lambda.at_least_once",
        "An event may be delivered more than once, so every function's effect may be repeated.",
        f"{_LAMBDA}/invocation-async-error-handling.html",
        "functions/summarize.py",
        "functions/live.py",
    ),
    # Whether an environment was kept shows only by chance.
    _documented(
        "lambda.environment_survives",
        "A handler that raises does not end its execution environment; the next event finds it warm.",
        f"{_LAMBDA}/lambda-runtime-environment.html",
        "functions/live.py",
    ),
    _documented(
        "lambda.python_logging",
        "Lambda sets up logging before it loads a function, and a logged line has its level.",
        f"{_LAMBDA}/python-logging.html",
        "functions/summarize.py",
        "local/log_gap.py",
    ),
    _documented(
        "lambda.reserved_concurrency",
        "A reservation that leaves an account fewer than 100 executions is refused.",
        f"{_LAMBDA}/configuration-concurrency.html",
        "stacks/settings.py",
    ),
    # Takes as long as records are kept.
    _documented(
        "dynamodb.stream_retention",
        "A stream keeps records for 24 hours, in the order of each partition key.",
        f"{_DYNAMODB}/Streams.html",
        "functions/summarize.py",
        "local/stream_gap.py",
        "local/stream_mapping.py",
    ),
    _documented(
        "dynamodb.ttl",
        "An expired item is deleted within a few days, and may be read until then.",
        f"{_DYNAMODB}/TTL.html",
        "stacks/storage.py",
    ),
    _documented(
        "dynamodb.query",
        "A Query reads at most 1 MB of one partition, in the order of the sort key.",
        f"{_DYNAMODB}/Query.Pagination.html",
        "station/iort_station/data/reading.py",
        "local/table_gap.py",
    ),
    _documented(
        "sqs.keeps_messages",
        "A message that SQS has accepted stays in the queue until it is deleted or expires.",
        "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-message-metadata.html",
        "stacks/quarantine.py",
        "local/queue_gap.py",
    ),
    # The hook's time-out would need a deployment of its own.
    _documented(
        "provisioning.hook_timeout",
        "A pre-provisioning hook that does not answer in 5 seconds counts as a refusal.",
        f"{_IOT}/pre-provisioning-hook.html",
        "functions/admit.py",
        "stacks/fleet.py",
    ),
    _documented(
        "provisioning.ownership_token",
        "The ownership token of a new certificate is valid for one hour.",
        f"{_IOT}/fleet-provision-api.html",
        "device/iort_agent/identity/provision.py",
    ),
    _documented(
        "broker.presence_order",
        "Presence events may come late and in another order; versionNumber orders those of one client.",
        f"{_IOT}/life-cycle-events.html",
        "functions/presence.py",
    ),
    _documented(
        "broker.certificate_deactivated",
        "A session whose certificate is deactivated is ended within minutes.",
        f"{_IOT}/device-certs-create.html",
        "station/iort_station/fleet/robots.py",
        "local/cut_sessions.py",
    ),
    _documented(
        "broker.slow_handshake",
        "A connection without a CONNECT is closed by the broker.",
        "https://docs.aws.amazon.com/general/latest/gr/iot-core.html",
        "local/listener_gap.py",
    ),
    # Only a bill shows it.
    _documented(
        "billing.basic_ingest",
        "A message on $aws/rules/<rule>/... is not metered as a message, and reaches no subscriber.",
        f"{_IOT}/iot-basic-ingest.html",
        "contract/iort_contract/topics.py",
        "station/iort_station/cost/model.py",
    ),
    _documented(
        "cloudformation.export_in_use",
        "An update that removes an export which another stack imports is refused and changes nothing.",
        "https://docs.aws.amazon.com/AWSCloudFormation/latest/UserGuide/using-cfn-stack-exports.html",
        "stacks/encryption.py",
    ),
    # The answer depends on the account's age.
    _documented(
        "cloudfront.verified_account",
        "A new account cannot make a CloudFront distribution before AWS has verified it.",
        "https://repost.aws/knowledge-center/cloudfront-verify-account",
        "stacks/site.py",
    ),
    _documented(
        "s3.unfinished_uploads",
        "A lifecycle rule deletes the parts of an upload that was never completed.",
        "https://docs.aws.amazon.com/AmazonS3/latest/userguide/mpu-abort-incomplete-mpu-lifecycle-config.html",
        "stacks/storage.py",
    ),
    _documented(
        "iot.shadow_resource",
        "A policy names a named shadow as a level of its thing: thing/<thing>/<shadow>.",
        f"{_IOT}/iot-action-resources.html",
        "stacks/processing.py",
        "local/stream_gap.py",
    ),
    _documented(
        "sqs.fair_queues",
        "In a standard queue no group of messages (MessageGroupId) waits long behind another.",
        "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-fair-queues.html",
        "functions/shared/share.py",
    ),
    _documented(
        "iot.rule_roles",
        "A rule's action runs as the role that the rule names; the emulator runs it without.",
        f"{_IOT}/iot-create-role.html",
        "stacks/ingest.py",
    ),
    # CloudFormation's console lines are not an interface.
    _assumed(
        "cdk.failed_deletion",
        "The CDK prints DELETE_FAILED and AWS::IoT::Policy in one line where a policy cannot be deleted yet.",
        "scripts/destroy.py",
    ),
)
