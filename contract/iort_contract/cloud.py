"""The names of the cloud's parts: the fleet's, PubNub's, of the files' bucket, and of those who watch."""

from __future__ import annotations

from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.analysis import DriveKey
from iort_contract.topics import CLAIM, check_namespace, check_robot

# Query results too large for an answer, in the files' bucket for a day.
RESULTS_PREFIX = "results/"
# What the analysis keeps there: the results of drives, and for a week the drives of each of its runs.
ANALYSIS_PREFIX = "analysis/"
PLANS_PREFIX = f"{ANALYSIS_PREFIX}plans/"
# The folder of a run's drives, all of which are analysed.
DRIVES = "drives"
# Ways of live messages to whoever looks: PubNub's servers, or AWS IoT's own WebSockets.
PUBNUB, IOT = "pubnub", "iot"
# Who else than robots connects to the broker, each as an IAM role.
VIEWER, DRIVER = "viewer", "driver"


def pubnub_parameter(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The Parameter Store name (SecureString) of PubNub's keys: a JSON object with ``publish_key``,
    ``subscribe_key`` and, for a server other than PubNub's own, ``origin`` and ``tls``."""
    return f"/{check_namespace(namespace)}/pubnub"


def fleet_name(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The name shared by the robots' thing type, thing group, IoT policy and provisioning template."""
    return f"{check_namespace(namespace)}-robot"


def claim_name(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The name of the claims' IoT policy, and the prefix of a claim's client id."""
    return f"{check_namespace(namespace)}-{CLAIM}"


def client_prefix(role: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """What a viewer's or driver's client id begins with; the rest is its own."""
    return f"{check_namespace(namespace)}-{role}-"


def channel(robot: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The PubNub channel of a robot; ``<namespace>.*`` subscribes to the whole fleet."""
    return f"{check_namespace(namespace)}.{check_robot(robot)}"


def drive_prefix(drive: DriveKey) -> str:
    """What the keys of a drive's results begin with: ``result.json``, and a Parquet file a table."""
    return f"{ANALYSIS_PREFIX}robot={check_robot(drive.robot)}/drive={drive}/"


def plan_key(job: str, robot: str, *, drives: bool = True) -> str:
    """The key of a robot's drives in a run of the analysis, or of the note that it has none."""
    return f"{PLANS_PREFIX}{job}/{DRIVES if drives else 'none'}/{check_robot(robot)}.json"


def robots_key(job: str) -> str:
    """The key of the robots of a run of the analysis, an item a robot with others to compare it with."""
    return f"{PLANS_PREFIX}{job}/robots.json"


def waiting_key(job: str, robot: str) -> str:
    """The key of what a run of the analysis leaves of a robot's drives to the next one."""
    return f"{PLANS_PREFIX}{job}/waiting/{check_robot(robot)}.json"


def findings_key(job: str, robot: str) -> str:
    """The key of a robot's findings in a run of the analysis."""
    return f"{PLANS_PREFIX}{job}/findings/{check_robot(robot)}.json"
