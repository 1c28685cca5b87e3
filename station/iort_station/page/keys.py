"""PubNub's keys, kept encrypted in Parameter Store; only Lambda 1 and the operator read them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

from iort_contract.cloud import pubnub_parameter
from iort_station.cloud import Cloud
from iort_station.errors import StationError


@dataclass(frozen=True, kw_only=True)
class PubNubKeys:
    """A key set; ``origin`` and ``tls`` select a server other than PubNub's own."""

    publish_key: str = field(repr=False)
    subscribe_key: str = field(repr=False)
    origin: str = ""
    tls: bool = True

    def reading(self) -> dict[str, Any]:
        """Keyword arguments for a listener or a page: the subscribe key, and a server other than PubNub's."""
        server = {"origin": self.origin, "tls": self.tls} if self.origin else {}
        return {"subscribe_key": self.subscribe_key, **server}


def typed(publish_key: str, subscribe_key: str) -> PubNubKeys:
    """Check keys of PubNub's own servers that somebody typed.

    Raises `StationError` for any other text, without repeating it: it may be the secret key.
    """
    typed_keys = {"publish": publish_key.strip(), "subscribe": subscribe_key.strip()}
    for kind, key in typed_keys.items():
        if not key.startswith(f"{kind[:3]}-c-"):
            raise StationError(f"the {kind} key must be {kind[:3]}-c-..., as PubNub's admin portal shows it")
    return PubNubKeys(publish_key=typed_keys["publish"], subscribe_key=typed_keys["subscribe"])


def store(cloud: Cloud, keys: PubNubKeys) -> None:
    """Write the keys, in place of stored ones."""
    value = {"publish_key": keys.publish_key, **keys.reading()}
    cloud.client("ssm").put_parameter(
        Name=pubnub_parameter(cloud.namespace), Value=json.dumps(value), Type="SecureString", Overwrite=True
    )


def load(cloud: Cloud) -> PubNubKeys:
    """Read the keys; raises `StationError` if none are stored."""
    ssm, name = cloud.client("ssm"), pubnub_parameter(cloud.namespace)
    try:
        answer = ssm.get_parameter(Name=name, WithDecryption=True)
    except ssm.exceptions.ParameterNotFound as error:
        raise StationError("PubNub's keys are not stored yet: run `iort pubnub`") from error
    try:
        return PubNubKeys(**json.loads(answer["Parameter"]["Value"]))
    except (TypeError, ValueError) as error:
        raise StationError(f"parameter {name} does not hold PubNub's keys") from error
