"""The names of the cloud's parts: the fleet's, PubNub's, and of the files' bucket."""

from __future__ import annotations

from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.topics import check_namespace, check_robot

# Query results too large for an answer, in the files' bucket for a day.
RESULTS_PREFIX = "results/"


def pubnub_parameter(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The Parameter Store name (SecureString) of PubNub's keys: a JSON object with ``publish_key``,
    ``subscribe_key`` and, for a server other than PubNub's own, ``origin`` and ``tls``."""
    return f"/{check_namespace(namespace)}/pubnub"


def fleet_name(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The name shared by the robots' thing type, thing group, IoT policy and provisioning template."""
    return f"{check_namespace(namespace)}-robot"


def claim_name(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The name of the claims' IoT policy, and the prefix of a claim's client id."""
    return f"{check_namespace(namespace)}-claim"


def channel(robot: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The PubNub channel of a robot; ``<namespace>.*`` subscribes to the whole fleet."""
    return f"{check_namespace(namespace)}.{check_robot(robot)}"
