"""What the design takes for granted and no program asks in half an hour."""

from __future__ import annotations

from verify.assumption import Assumption, Basis

_IOT = "https://docs.aws.amazon.com/iot/latest/developerguide"
_LAMBDA = "https://docs.aws.amazon.com/lambda/latest/dg"
_CLOUDWATCH = "https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring"
_DYNAMODB = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide"


def _documented(name: str, assumed: str, source: str, *relied_on_by: str) -> Assumption:
    return Assumption(
        name=name, assumed=assumed, basis=Basis.DOCUMENTED, source=source, relied_on_by=relied_on_by
    )


def _assumed(name: str, assumed: str, *relied_on_by: str) -> Assumption:
    return Assumption(name=name, assumed=assumed, basis=Basis.ASSUMED, relied_on_by=relied_on_by)


UNASKED = (
    # Nobody can order an outage of Lambda.
    _documented(
        "lambda.asynchronous",
        "A rule's invocation waits in a queue of Lambda. A throttled one is retried for up to six "
        "hours, a failed one as often as the function's settings say; then it goes to the destination for "
        "failures.",
        f"{_LAMBDA}/invocation-async-error-handling.html",
        "stacks/processing.py",
        "local/gaps/functions/async_invocations.py",
    ),
    _documented(
        "lambda.at_least_once",
        "An event may be delivered more than once, so every function's effect may be repeated.",
        f"{_LAMBDA}/invocation-async-error-handling.html",
        "functions/summarize.py",
        "functions/live.py",
    ),
    # A warm environment shows only by chance.
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
        "local/gaps/functions/log_levels.py",
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
        "local/gaps/functions/stream_retries.py",
        "local/gaps/parts/stream_mapping.py",
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
        "contract/iort_contract/dynamodb.py",
        "local/gaps/storage/query_time.py",
    ),
    _documented(
        "sqs.keeps_messages",
        "A message that SQS has accepted stays in the queue until it is deleted or expires.",
        "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-message-metadata.html",
        "stacks/quarantine.py",
        "local/gaps/storage/queue_lock.py",
    ),
    # The hook's timeout would need a deployment of its own.
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
        "device/iort_agent/verbs/provision.py",
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
        "local/gaps/broker/certificate_status.py",
    ),
    _documented(
        "broker.slow_handshake",
        "A connection without a CONNECT is closed by the broker.",
        "https://docs.aws.amazon.com/general/latest/gr/iot-core.html",
        "local/gaps/broker/connect_timeout.py",
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
        "local/gaps/access/shadow_arn.py",
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
    _documented(
        "iot.topic_templates",
        "A republish action's topic may hold ${topic(n)}.",
        f"{_IOT}/iot-substitution-templates.html",
        "contract/iort_contract/cloud.py",
        "local/gaps/rules/republish_topic.py",
    ),
    _documented(
        "iot.sql_floor",
        "The SQL function floor() rounds a number down to an integer.",
        f"{_IOT}/iot-sql-functions.html",
        "contract/iort_contract/cloud.py",
        "local/gaps/rules/sql_floor.py",
    ),
    _documented(
        "iot.calls_over_tls",
        "A rule's SQS action is a request over TLS, so that a queue's policy may demand aws:SecureTransport.",
        "https://docs.aws.amazon.com/IAM/latest/UserGuide/reference_policies_condition-keys.html",
        "stacks/queue.py",
        "local/gaps/rules/sqs_action_tls.py",
    ),
    _documented(
        "broker.delete_connection",
        "DeleteConnection ends the session of one client.",
        "https://docs.aws.amazon.com/iot/latest/apireference/API_iotdata_DeleteConnection.html",
        "station/iort_station/fleet/certificates.py",
        "local/gaps/broker/delete_connection.py",
    ),
    _documented(
        "broker.client_certificate",
        "A client without a certificate is not served on port 8883.",
        f"{_IOT}/x509-client-certs.html",
        "stacks/documents.py",
        "local/gaps/broker/client_certificate.py",
    ),
    _documented(
        "sqs.batch_permission",
        "SendMessageBatch needs the permission sqs:SendMessage.",
        "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-api-permissions-reference.html",
        "functions/shared/share.py",
        "local/gaps/access/send_message_batch.py",
    ),
    _documented(
        "dynamodb.stream_resource",
        "A role may be granted the reading of one stream, by its ARN.",
        "https://docs.aws.amazon.com/service-authorization/latest/reference/list_amazondynamodb.html",
        "stacks/quarantine.py",
        "local/gaps/access/stream_arn.py",
    ),
    _documented(
        "cloudwatch.lambda_metrics",
        "AWS/Lambda counts every invocation, for each function and for the account.",
        f"{_LAMBDA}/monitoring-metrics-types.html",
        "stacks/metrics.py",
        "local/gaps/metrics/lambda_metrics.py",
    ),
    _documented(
        "cloudwatch.iot_metrics",
        "AWS/IoT counts connections, messages, and the matches and actions of rules.",
        f"{_IOT}/metrics_dimensions.html",
        "stacks/metrics.py",
        "local/gaps/metrics/iot_metrics.py",
    ),
    _documented(
        "cloudwatch.queue_metrics",
        "AWS/SQS counts the messages that wait in each queue.",
        "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-available-cloudwatch-metrics.html",
        "stacks/metrics.py",
        "local/gaps/metrics/queue_metrics.py",
    ),
    _documented(
        "cloudwatch.search",
        "SEARCH in GetMetricData finds metrics by namespace, dimensions and name.",
        f"{_CLOUDWATCH}/search-expression-syntax.html",
        "stacks/metrics.py",
        "local/gaps/metrics/metric_search.py",
    ),
    _documented(
        "cloudwatch.alarm_evaluation",
        "An alarm is evaluated every period, with its own dimensions, whether data comes or not.",
        f"{_CLOUDWATCH}/AlarmThatSendsEmail.html",
        "stacks/alarms.py",
        "local/gaps/metrics/alarm_state.py",
        "local/gaps/metrics/alarm_timer.py",
    ),
    # CloudFormation's console lines are not an interface.
    _assumed(
        "cdk.failed_deletion",
        "The CDK prints DELETE_FAILED and AWS::IoT::Policy in one line if a policy cannot be deleted yet.",
        "scripts/destroy.py",
    ),
)
