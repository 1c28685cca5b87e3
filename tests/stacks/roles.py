"""The permissions of every role of the stacks: each action on each resource, and who may assume it."""

from __future__ import annotations

from iort_contract.archive import ARCHIVE_PREFIX, DUE_MS, FIRST_DUE_MS, HOUR
from iort_contract.cloud import ANALYSIS_PREFIX, PLANS_PREFIX, RESULTS_PREFIX
from iort_contract.messages.files import FILES_PREFIX
from iort_contract.messages.questions import ASK_FOLDER
from iort_contract.tables import (
    BATCH,
    EXPIRES_S,
    PRESENCE,
    PUT_OFF_TO_S,
    RECORD_BYTES,
    RECORD_DAY,
    STREAMS,
    TOPIC,
)
from iort_contract.topics import SHADOW
from stacks.checks import EVERY_RESOURCE, LOG_DELIVERY

IOT = "arn:${AWS::Partition}:iot:${AWS::Region}:${AWS::AccountId}"
STATES = "arn:${AWS::Partition}:states:${AWS::Region}:${AWS::AccountId}"
THINGS, CERTIFICATES = f"{IOT}:thing/*", f"{IOT}:cert/*"
GROUP, KIND = f"{IOT}:thinggroup/iort-robot", f"{IOT}:thingtype/iort-robot"
# These actions of provisioning have no resource type, or only a certificate that does not exist yet.
ANY_PROVISIONING = {action[4:] for role, action in EVERY_RESOURCE if role == "ProvisioningRole"}
PROVISIONING = (
    {(f"iot:{action}", resource) for action in ("CreateThing", "UpdateThing") for resource in (THINGS, KIND)}
    | {
        (f"iot:{action}", THINGS)
        for action in ("DescribeThing", "ListThingGroupsForThing", "ListThingPrincipals")
    }
    | {
        (f"iot:{action}", CERTIFICATES)
        for action in (
            *("AttachPolicy", "AttachPrincipalPolicy", "DescribeCertificate", "DetachPolicy"),
            "UpdateCertificate",
        )
    }
    | {
        (f"iot:{action}", resource)
        for action in ("AddThingToThingGroup", "RemoveThingFromThingGroup", "UpdateThingGroupsForThing")
        for resource in (THINGS, GROUP)
    }
    | {
        (f"iot:{action}", resource)
        for action in ("AttachThingPrincipal", "DetachThingPrincipal")
        for resource in (THINGS, CERTIFICATES)
    }
    | {("iot:DescribeThingType", KIND), ("iot:DescribeThingGroup", GROUP)}
    | {(f"iot:{action}", f"{IOT}:policy/iort-robot") for action in ("GetPolicy", "ListTargetsForPolicy")}
    | {(f"iot:{action}", "*") for action in ANY_PROVISIONING}
)
# AWS' managed policy for registering things, version 3 of 2020-10-05, which allows all of it on "*":
# "AWS managed policies", AWSIoTThingsRegistration.
THINGS_REGISTRATION = {
    *("AddThingToBillingGroup", "AddThingToThingGroup", "AttachPolicy", "AttachPrincipalPolicy"),
    *("AttachThingPrincipal", "CreateCertificateFromCsr", "CreatePolicy", "CreateThing"),
    *("DescribeBillingGroup", "DescribeCertificate", "DescribeThing", "DescribeThingGroup"),
    *("DescribeThingType", "DetachPolicy", "DetachThingPrincipal", "GetPolicy", "ListAttachedPolicies"),
    *("ListPolicyPrincipals", "ListPrincipalPolicies", "ListPrincipalThings", "ListTargetsForPolicy"),
    *("ListThingGroupsForThing", "ListThingPrincipals", "RegisterCertificate", "RegisterThing"),
    *("RemoveThingFromBillingGroup", "RemoveThingFromThingGroup", "UpdateCertificate", "UpdateThing"),
    "UpdateThingGroupsForThing",
}
# The actions that our role lacks, with the reason.
NOT_REGISTERED = {
    "AddThingToBillingGroup": "the template names no billing group",
    "CreateCertificateFromCsr": "a robot asks for it itself, by MQTT; this is for tasks of many things",
    "CreatePolicy": "the template names a policy that exists; who makes one could allow everything",
    "DescribeBillingGroup": "the template names no billing group",
    "RegisterCertificate": "the certificates are AWS' own, registered when they are made",
    "RemoveThingFromBillingGroup": "the template names no billing group",
}

# Permissions of the audit's checks: all certificates and policies.
AUDIT_READS = {action for role, action in EVERY_RESOURCE if role == "AuditRole"}
LOG_OF_IOT = "arn:${AWS::Partition}:logs:${AWS::Region}:${AWS::AccountId}:log-group:AWSIotLogsV2:*"

LOG = {"logs:CreateLogStream", "logs:PutLogEvents"}
REJECT = ("sqs:SendMessage", "Rejected.Arn")
# The CDK's permissions for a sender to a queue as a destination.
DESTINATION = {REJECT, ("sqs:GetQueueAttributes", "Rejected.Arn"), ("sqs:GetQueueUrl", "Rejected.Arn")}
# Permissions of a function that reads batches and writes seconds.
SUMMARIZES = {
    ("dynamodb:Query", "Batches.Arn"),
    ("dynamodb:BatchWriteItem", "Summary.Arn"),
    ("dynamodb:GetItem", "Robots.Arn"),
    ("dynamodb:UpdateItem", "Robots.Arn"),
    ("dynamodb:UpdateItem", "Archive.Arn"),
}
CONSUME = ("ReceiveMessage", "DeleteMessage", "ChangeMessageVisibility", "GetQueueAttributes", "GetQueueUrl")
# Permissions of the functions that find and analyse drives.
READS_DRIVES = {
    ("dynamodb:Query", "Batches.Arn"),
    ("dynamodb:Query", "Archive.Arn"),
    ("s3:GetObject", f"Files.Arn/{ARCHIVE_PREFIX}*"),
    ("dynamodb:GetItem", "Robots.Arn"),
}
# For every role: each action on each resource, and who may assume it.
# People of the account, if their own policy lets them assume the role.
PEOPLE = "arn:${AWS::Partition}:iam::${AWS::AccountId}:root"


def listens(robots: str = "") -> set[tuple[str, str]]:
    """The permissions to hear robots' live messages."""
    return {
        ("iot:Subscribe", f"{IOT}:topicfilter/live/iort/{robots}*"),
        ("iot:Receive", f"{IOT}:topic/live/iort/{robots}*"),
    }


def publishes(*lanes: str) -> set[tuple[str, str]]:
    """The permission to send messages to every robot."""
    return {("iot:Publish", f"{IOT}:topic/{lane}/iort/*") for lane in lanes}


def connects(name: str) -> set[tuple[str, str]]:
    """The permission to connect under this name."""
    return {("iot:Connect", f"{IOT}:client/iort-{name}-*")}


# What everybody gets from the page on the web.
PUBLIC = connects("viewer") | listens()
ROLES = {
    "Viewer": (PEOPLE, connects("viewer") | listens() | publishes("view")),
    "Driver": (PEOPLE, connects("driver") | listens() | publishes("view", "cmd")),
    "LiveRole": (
        "lambda.amazonaws.com",
        {(action, "LiveLog.Arn") for action in LOG}
        | DESTINATION
        | {
            (
                "ssm:GetParameter",
                "arn:${AWS::Partition}:ssm:${AWS::Region}:${AWS::AccountId}:parameter/iort/pubnub",
            )
        },
    ),
    "SummarizeRole": (
        "lambda.amazonaws.com",
        {(action, "SummarizeLog.Arn") for action in LOG}
        | SUMMARIZES
        | {
            ("dynamodb:DescribeStream", "Batches.StreamArn"),
            ("dynamodb:GetRecords", "Batches.StreamArn"),
            ("dynamodb:GetShardIterator", "Batches.StreamArn"),
            ("dynamodb:ListStreams", "*"),
            ("sqs:SendMessage", "PutOff.Arn"),
            ("iot:UpdateThingShadow", f"{IOT}:thing/*/{SHADOW}"),
        }
        | DESTINATION,
    ),
    "LaterRole": (
        "lambda.amazonaws.com",
        {(action, "LaterLog.Arn") for action in LOG}
        | SUMMARIZES
        | {("dynamodb:GetItem", "Batches.Arn")}
        | {(f"sqs:{action}", "PutOff.Arn") for action in CONSUME}
        | DESTINATION,
    ),
    "ArchiveRole": (
        "lambda.amazonaws.com",
        {(action, "ArchiveLog.Arn") for action in LOG}
        | {("dynamodb:Query", "Batches.Arn"), ("dynamodb:UpdateItem", "Batches.Arn")}
        | {
            (f"dynamodb:{action}", "Archive.Arn")
            for action in ("GetItem", "PutItem", "UpdateItem", "DeleteItem", "Query")
        }
        | {("dynamodb:Scan", "Robots.Arn"), ("s3:ListBucket", "Files.Arn")}
        | {
            (f"s3:{action}", f"Files.Arn/{ARCHIVE_PREFIX}*")
            for action in ("DeleteObject", "GetObject", "PutObject")
        }
        | {(f"sqs:{action}", "ArchiveTasks.Arn") for action in ("SendMessage", *CONSUME)},
    ),
    "ScheduleRole": ("scheduler.amazonaws.com", {("lambda:InvokeFunction", "Archive.Arn")}),
    "EchoRole": (
        "lambda.amazonaws.com",
        {(action, "EchoLog.Arn") for action in LOG}
        | DESTINATION
        | {("iot:Publish", f"{IOT}:topic/pong/iort/*/lambda")},
    ),
    "QuarantineRole": (
        "lambda.amazonaws.com",
        {(action, "QuarantineLog.Arn") for action in LOG}
        | {
            ("dynamodb:UpdateItem", "Quarantine.Arn"),
            ("dynamodb:GetRecords", "Batches.StreamArn"),
            ("dynamodb:GetShardIterator", "Batches.StreamArn"),
            ("sqs:ReceiveMessage", "Rejected.Arn"),
            ("sqs:DeleteMessage", "Rejected.Arn"),
            ("sqs:ChangeMessageVisibility", "Rejected.Arn"),
            ("sqs:GetQueueAttributes", "Rejected.Arn"),
            ("sqs:GetQueueUrl", "Rejected.Arn"),
        },
    ),
    "QueryRole": (
        "lambda.amazonaws.com",
        {(action, "QueryLog.Arn") for action in LOG}
        | {("dynamodb:Query", "Batches.Arn"), ("dynamodb:Scan", "Batches.Arn")}
        | {("dynamodb:GetItem", "Robots.Arn")}
        | {(f"s3:{action}", f"Files.Arn/{RESULTS_PREFIX}*") for action in ("GetObject", "PutObject")},
    ),
    "UploadRole": (
        "lambda.amazonaws.com",
        {(action, "UploadLog.Arn") for action in LOG}
        | DESTINATION
        | {
            (f"s3:{action}", f"Files.Arn/{FILES_PREFIX}*")
            for action in ("AbortMultipartUpload", "ListMultipartUploadParts", "PutObject")
        }
        | {(f"s3:{action}", "Files.Arn") for action in ("ListBucket", "ListBucketMultipartUploads")}
        | {("dynamodb:UpdateItem", "Robots.Arn"), ("iot:Publish", f"{IOT}:topic/pong/iort/*/file")},
    ),
    "AnswerRole": (
        "lambda.amazonaws.com",
        {(action, "AnswerLog.Arn") for action in LOG}
        | DESTINATION
        | {("dynamodb:Query", "Findings.Arn"), ("dynamodb:UpdateItem", "Robots.Arn")}
        | {("iot:Publish", f"{IOT}:topic/answer/iort/*/*")}
        | {("s3:GetObject", f"Files.Arn/{FILES_PREFIX}*/{ASK_FOLDER}/*")}
        | {
            (f"s3:{action}", f"Files.Arn/{RESULTS_PREFIX}{ASK_FOLDER}/*")
            for action in ("GetObject", "PutObject")
        },
    ),
    "AdmitRole": (
        "lambda.amazonaws.com",
        {(action, "AdmitLog.Arn") for action in LOG}
        | {("dynamodb:UpdateItem", "Robots.Arn"), ("iot:DescribeCertificate", f"{IOT}:cert/*")},
    ),
    "PresenceRole": (
        "lambda.amazonaws.com",
        {(action, "PresenceLog.Arn") for action in LOG}
        | DESTINATION
        | {("dynamodb:UpdateItem", "Robots.Arn")},
    ),
    "AlertRole": (
        "lambda.amazonaws.com",
        {(action, "AlertLog.Arn") for action in LOG}
        | DESTINATION
        | {("dynamodb:UpdateItem", "Robots.Arn"), ("sns:Publish", "Alarms")},
    ),
    "PlanRole": (
        "lambda.amazonaws.com",
        {(action, "PlanLog.Arn") for action in LOG}
        | READS_DRIVES
        | {
            ("dynamodb:Scan", "Robots.Arn"),
            ("dynamodb:Query", "Findings.Arn"),
            ("s3:PutObject", f"Files.Arn/{PLANS_PREFIX}*"),
        },
    ),
    "AnalyseRole": (
        "lambda.amazonaws.com",
        {(action, "AnalyseLog.Arn") for action in LOG}
        | READS_DRIVES
        | {
            ("dynamodb:PutItem", "Findings.Arn"),
            ("s3:PutObject", f"Files.Arn/{ANALYSIS_PREFIX}robot=*"),
        },
    ),
    "EvaluateRole": (
        "lambda.amazonaws.com",
        {(action, "EvaluateLog.Arn") for action in LOG}
        | {
            ("dynamodb:Query", "Findings.Arn"),
            ("s3:ListBucket", "Files.Arn"),
            ("s3:GetObject", f"Files.Arn/{ANALYSIS_PREFIX}*"),
            ("s3:PutObject", f"Files.Arn/{PLANS_PREFIX}*"),
        },
    ),
    "PresentRole": (
        "lambda.amazonaws.com",
        {(action, "PresentLog.Arn") for action in LOG}
        | {(f"dynamodb:{action}", "Findings.Arn") for action in ("Query", "PutItem", "DeleteItem")}
        | {("s3:GetObject", f"Files.Arn/{PLANS_PREFIX}*"), ("sns:Publish", "Alarms")}
        | {("s3:ListBucket", "Files.Arn"), ("s3:DeleteObject", f"Files.Arn/{ANALYSIS_PREFIX}robot=*")},
    ),
    "MachineRole": (
        "states.amazonaws.com",
        {("lambda:InvokeFunction", f"{name}.Arn") for name in ("Plan", "Analyse", "Evaluate", "Present")}
        | {(action, "*") for action in LOG_DELIVERY}
        | {
            ("s3:ListBucket", "Files.Arn"),
            ("s3:GetObject", f"Files.Arn/{PLANS_PREFIX}*"),
            # "IAM policies for using Distributed Map states".
            ("states:StartExecution", "Machine"),
            *(
                (f"states:{action}", f"{STATES}:execution:Machine.Name:*")
                for action in ("DescribeExecution", "StopExecution")
            ),
        },
    ),
    "NightlyRole": ("scheduler.amazonaws.com", {("states:StartExecution", "Machine")}),
    "ProvisioningRole": ("iot.amazonaws.com", PROVISIONING),
    "AuditRole": ("iot.amazonaws.com", {(action, "*") for action in AUDIT_READS}),
    "LogRole": (
        "iot.amazonaws.com",
        {(f"logs:{action}", LOG_OF_IOT) for action in ("CreateLogGroup", "CreateLogStream", "PutLogEvents")},
    ),
    "ingest/RecordRole": ("iot.amazonaws.com", {REJECT, ("dynamodb:PutItem", "Batches.Arn")}),
    "ingest/LiveRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/PongRole": ("iot.amazonaws.com", {REJECT, ("iot:Publish", f"{IOT}:topic/pong/iort/*/rule")}),
    "ingest/EchoRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/UploadRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/AskRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/FaultRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/BatteryRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/PresenceRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/VersionRole": ("iot.amazonaws.com", {REJECT}),
}
# The attributes of a robot's row that each function may change.
KEEPS = {
    "AlertRole": ("alert_*",),
    "PresenceRole": PRESENCE,
    "LaterRole": (STREAMS,),
    "SummarizeRole": (RECORD_BYTES, RECORD_DAY, STREAMS),
    "UploadRole": ("files_bytes", "files_day"),
    "AnswerRole": ("asked_*",),
}
# The attributes of other items that a function may change, by its role and the table.
CHANGES = {
    ("ArchiveRole", "Batches.Arn"): (BATCH, EXPIRES_S, PUT_OFF_TO_S, TOPIC),
    ("LaterRole", "Archive.Arn"): (DUE_MS, FIRST_DUE_MS, HOUR, TOPIC),
    ("SummarizeRole", "Archive.Arn"): (DUE_MS, FIRST_DUE_MS, HOUR, TOPIC),
}
