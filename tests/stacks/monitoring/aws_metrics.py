"""The metrics of AWS that the stacks may name."""

from __future__ import annotations

# Dimensions of each metric. AWS IoT Developer Guide, "AWS IoT metrics and dimensions"; Lambda Developer
# Guide, "Types of metrics for Lambda functions"; DynamoDB Developer Guide, "DynamoDB metrics and
# dimensions"; SQS Developer Guide, "Available CloudWatch metrics for Amazon SQS";
# Step Functions Developer Guide, "Execution metrics".
AWS_METRICS = {
    ("AWS/IoT", "Protocol"): {
        f"{what}.{how}"
        for what in ("Connect", "PublishIn", "PublishOut", "Subscribe")
        for how in ("Success", "AuthError", "Throttle")
    },
    ("AWS/IoT", "RuleName"): {"TopicMatch", "ParseError", "RuleMessageThrottled"},
    ("AWS/IoT", "ActionType", "RuleName"): {"Failure", "Success", "ErrorActionFailure"},
    ("AWS/Lambda", "FunctionName"): {
        "Duration",
        "ConcurrentExecutions",
        "Errors",
        "Throttles",
        "IteratorAge",
        "DestinationDeliveryFailures",
    },
    # "Across all functions".
    ("AWS/Lambda",): {"ConcurrentExecutions", "Errors", "Throttles"},
    ("AWS/DynamoDB", "TableName"): {
        "ConsumedReadCapacityUnits",
        "ConsumedWriteCapacityUnits",
        "ReadThrottleEvents",
        "WriteThrottleEvents",
    },
    ("AWS/SQS", "QueueName"): {"ApproximateNumberOfMessagesVisible"},
    ("AWS/States", "StateMachineArn"): {"ExecutionsFailed"},
}
