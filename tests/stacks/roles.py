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
SSM = IOT.replace(":iot:", ":ssm:")
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
# Permissions of the audit's checks: all certificates and policies.
AUDIT_READS = {action for role, action in EVERY_RESOURCE if role == "AuditRole"}
LOG_OF_IOT = "arn:${AWS::Partition}:logs:${AWS::Region}:${AWS::AccountId}:log-group:AWSIotLogsV2:*"

LOG = {"logs:CreateLogStream", "logs:PutLogEvents"}
REJECT = ("sqs:SendMessage", "Rejected.Arn")
# The CDK's permissions for a sender to a queue as a destination.
DESTINATION = {REJECT, ("sqs:GetQueueAttributes", "Rejected.Arn"), ("sqs:GetQueueUrl", "Rejected.Arn")}
# Permissions of a function that reads batches and writes seconds.
SUMMARIZES = {
    ("lambda:InvokeFunction", "Incident.Arn"),
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
# People of the account, if their own policy lets them assume the role.
PEOPLE = "arn:${AWS::Partition}:iam::${AWS::AccountId}:root"


RELAYS = ("GetIceServerConfig", "GetSignalingChannelEndpoint")


def listener(name: str) -> set[tuple[str, str]]:
    """The permissions to connect, and to hear robots' live messages."""
    return {
        ("iot:Connect", f"{IOT}:client/iort-{name}-*"),
        ("iot:Subscribe", f"{IOT}:topicfilter/live/iort/*"),
        ("iot:Receive", f"{IOT}:topic/live/iort/*"),
    }


def person(name: str, *sends: str) -> set[tuple[str, str]]:
    """The permissions to look at every robot, and to send on the topics."""
    looks = {"view/iort/*/lease", "view/iort/*/video"}
    return {
        *listener(name),
        *(("iot:Publish", f"{IOT}:topic/{topic}") for topic in (*looks, *sends)),
        *(("iot:Subscribe", f"{IOT}:topicfilter/view/iort/*/{last}") for last in ("picture", "to-*")),
        *(("iot:Receive", f"{IOT}:topic/view/iort/*/{last}") for last in ("picture", "to-*")),
        # Relays, with `turn`.
        *((f"kinesisvideo:{action}", "Turn.Arn") for action in RELAYS),
    }


# By function, beside the writing of its own log.
OF_FUNCTIONS = {
    "Live": DESTINATION | {("ssm:GetParameter", f"{SSM}:parameter/iort/pubnub")},
    "Summarize": DESTINATION
    | SUMMARIZES
    | {
        ("dynamodb:DescribeStream", "Batches.StreamArn"),
        ("dynamodb:GetRecords", "Batches.StreamArn"),
        ("dynamodb:GetShardIterator", "Batches.StreamArn"),
        ("dynamodb:ListStreams", "*"),
        ("sqs:SendMessage", "PutOff.Arn"),
        ("iot:UpdateThingShadow", f"{IOT}:thing/*/{SHADOW}"),
    },
    "Later": DESTINATION
    | SUMMARIZES
    | {("dynamodb:GetItem", "Batches.Arn")}
    | {(f"sqs:{action}", "PutOff.Arn") for action in CONSUME},
    "Archive": {("dynamodb:Query", "Batches.Arn"), ("dynamodb:UpdateItem", "Batches.Arn")}
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
    "Echo": DESTINATION | {("iot:Publish", f"{IOT}:topic/pong/iort/*/lambda")},
    "Quarantine": {
        ("dynamodb:UpdateItem", "Quarantine.Arn"),
        ("dynamodb:GetRecords", "Batches.StreamArn"),
        ("dynamodb:GetShardIterator", "Batches.StreamArn"),
        *((f"sqs:{action}", "Rejected.Arn") for action in CONSUME),
    },
    "Query": {("dynamodb:Query", "Batches.Arn"), ("dynamodb:Scan", "Batches.Arn")}
    | {("dynamodb:GetItem", "Robots.Arn")}
    | {(f"s3:{action}", f"Files.Arn/{RESULTS_PREFIX}*") for action in ("GetObject", "PutObject")},
    "Upload": DESTINATION
    | {
        (f"s3:{action}", f"Files.Arn/{FILES_PREFIX}*")
        for action in ("AbortMultipartUpload", "ListMultipartUploadParts", "PutObject")
    }
    | {(f"s3:{action}", "Files.Arn") for action in ("ListBucket", "ListBucketMultipartUploads")}
    | {("dynamodb:UpdateItem", "Robots.Arn"), ("iot:Publish", f"{IOT}:topic/pong/iort/*/file")},
    "Answer": DESTINATION
    | {("dynamodb:Query", "Findings.Arn"), ("dynamodb:UpdateItem", "Robots.Arn")}
    | {("iot:Publish", f"{IOT}:topic/answer/iort/*/*")}
    | {("s3:GetObject", f"Files.Arn/{FILES_PREFIX}*/{ASK_FOLDER}/*")}
    | {
        (f"s3:{action}", f"Files.Arn/{RESULTS_PREFIX}{ASK_FOLDER}/*") for action in ("GetObject", "PutObject")
    },
    "Admit": {("dynamodb:UpdateItem", "Robots.Arn"), ("iot:DescribeCertificate", f"{IOT}:cert/*")},
    "Presence": DESTINATION | {("dynamodb:UpdateItem", "Robots.Arn")},
    "Alert": DESTINATION | {("dynamodb:UpdateItem", "Robots.Arn"), ("sns:Publish", "Alarms")},
    "Incident": DESTINATION
    | {("dynamodb:GetItem", "Robots.Arn"), ("dynamodb:UpdateItem", "Robots.Arn"), ("sns:Publish", "Alarms")}
    | {("ssm:GetParameter", f"{SSM}:parameter/iort/webhook")},
    "Plan": READS_DRIVES
    | {
        ("dynamodb:Scan", "Robots.Arn"),
        ("dynamodb:Query", "Findings.Arn"),
        ("s3:PutObject", f"Files.Arn/{PLANS_PREFIX}*"),
    },
    "Analyse": READS_DRIVES
    | {("dynamodb:PutItem", "Findings.Arn"), ("s3:PutObject", f"Files.Arn/{ANALYSIS_PREFIX}robot=*")},
    "Evaluate": {
        ("dynamodb:Query", "Findings.Arn"),
        ("s3:ListBucket", "Files.Arn"),
        ("s3:GetObject", f"Files.Arn/{ANALYSIS_PREFIX}*"),
        ("s3:PutObject", f"Files.Arn/{PLANS_PREFIX}*"),
    },
    "Present": {(f"dynamodb:{action}", "Findings.Arn") for action in ("Query", "PutItem", "DeleteItem")}
    | {("s3:GetObject", f"Files.Arn/{PLANS_PREFIX}*"), ("sns:Publish", "Alarms")}
    | {("s3:ListBucket", "Files.Arn"), ("s3:DeleteObject", f"Files.Arn/{ANALYSIS_PREFIX}robot=*")}
    | {(f"iot:{verb}ThingShadow", f"{IOT}:thing/*/{SHADOW}") for verb in ("Get", "Update")},
}
# The topic rules' roles beside the sending of what fails.
OF_RULES = {
    "Record": {("dynamodb:PutItem", "Batches.Arn")},
    "Pong": {("iot:Publish", f"{IOT}:topic/pong/iort/*/rule")},
    **{name: set() for name in ("Live", "Echo", "Upload", "Ask", "Fault", "Battery", "Presence", "Version")},
}

# What everybody gets from the page on the web.
PUBLIC = listener("viewer")
# For every role: who may assume it, and each action on each resource.
ROLES = {
    "Viewer": (PEOPLE, person("viewer")),
    "Driver": (PEOPLE, person("driver", "cmd/iort/*")),
    **{
        f"{name}Role": ("lambda.amazonaws.com", {(action, f"{name}Log.Arn") for action in LOG} | grants)
        for name, grants in OF_FUNCTIONS.items()
    },
    **{f"ingest/{name}Role": ("iot.amazonaws.com", {REJECT} | grants) for name, grants in OF_RULES.items()},
    "ScheduleRole": ("scheduler.amazonaws.com", {("lambda:InvokeFunction", "Archive.Arn")}),
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
}
# The attributes of a robot's row that each function may change.
KEEPS = {
    "AlertRole": ("alert_*",),
    "IncidentRole": ("incident_*",),
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
