"""The rights of viewers and drivers at the broker: an IAM role's credentials, and an address signed with
them."""

from __future__ import annotations

import secrets
import time
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote, urlsplit

from botocore.auth import SigV4QueryAuth
from botocore.awsrequest import AWSRequest
from botocore.credentials import ReadOnlyCredentials
from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.cloud import DRIVER, PUBNUB, VIEWER, client_prefix
from iort_station.errors import StationError

if TYPE_CHECKING:
    from iort_station.cloud import Cloud

# AWS IoT's data plane, in a signature.
_SERVICE = "iotdevicegateway"
# AWS refuses a signature that is older than 5 minutes.
_SIGNED_S = 300
# An assumed role's credentials are good for an hour; new ones are fetched this long before.
_LASTS_S, _EARLY_S = 3600, 600


class Signed(NamedTuple):
    """An address that opens connections to the broker within 5 minutes, and the client id for one."""

    url: str
    client_id: str


class Role:
    """The credentials of a deployment's role ``viewer`` or ``driver``, renewed when they end.

    May be used from several threads.
    """

    def __init__(self, cloud: Cloud, name: str = VIEWER) -> None:
        self._cloud, self.name = cloud, name
        self._got: tuple[float, ReadOnlyCredentials] | None = None

    def credentials(self) -> ReadOnlyCredentials:
        """Credentials that are good for at least ten minutes; raises `StationError` if the role cannot be
        assumed."""
        # Not the monotonic clock, which stands while a laptop sleeps.
        if self._got is None or time.time() > self._got[0]:
            self._got = time.time() + _LASTS_S - _EARLY_S, self._assume()
        return self._got[1]

    def client_id(self) -> str:
        """A new client id that the role may connect as."""
        return f"{client_prefix(self.name, self._cloud.namespace)}{secrets.token_hex(8)}"

    def signed(self) -> Signed:
        """A new address for a browser; raises `StationError` if the role cannot be assumed."""
        signed = signed_url(
            self._cloud.websocket_url, self.credentials(), region=self._cloud.region_name or ""
        )
        return Signed(signed, self.client_id())

    def _assume(self) -> ReadOnlyCredentials:
        arn = role_arn(self._cloud, self.name)
        try:
            got = self._cloud.client("sts").assume_role(
                RoleArn=arn, RoleSessionName=f"iort-{self.name}", DurationSeconds=_LASTS_S
            )["Credentials"]
        except (BotoCoreError, ClientError) as error:
            raise StationError(
                f"the role of a {self.name} cannot be assumed: {error}. Your own policy must allow "
                f"sts:AssumeRole on {arn}"
            ) from error
        return ReadOnlyCredentials(got["AccessKeyId"], got["SecretAccessKey"], got["SessionToken"])


def role_arn(cloud: Cloud, name: str) -> str:
    """The role's ARN; raises `StationError` if the deployment has no such role."""
    found = cloud.find_output("fleet", f"{name.capitalize()}Role")
    if found is None:
        needed = "-c drivers=true" if name == DRIVER else "the current stacks"
        raise StationError(f"the deployment {cloud.namespace} has no role for a {name}: deploy {needed}")
    return found


def transport(cloud: Cloud) -> str:
    """The deployment's way to the page: ``pubnub`` or ``iot``."""
    return cloud.find_output("fleet", "LiveTransport") or PUBNUB


def has_drivers(cloud: Cloud) -> bool:
    """Whether the deployment has a role for drivers."""
    return cloud.find_output("fleet", "DriverRole") is not None


def signed_url(url: str, credentials: ReadOnlyCredentials, *, region: str) -> str:
    """Sign the address of the broker's WebSocket with Signature Version 4 in its query.

    AWS IoT expects the session's token after the signature, and not in what is signed: "AWS IoT Core,
    IAM users, groups, and roles".
    """
    unsigned = ReadOnlyCredentials(credentials.access_key, credentials.secret_key, None)
    address = urlsplit(url)
    # The signature covers the host, not the scheme, and botocore knows HTTP's alone.
    request = AWSRequest("GET", f"https://{address.netloc}{address.path}")
    request.headers["Host"] = address.netloc
    SigV4QueryAuth(unsigned, _SERVICE, region, expires=_SIGNED_S).add_auth(request)
    token = f"&X-Amz-Security-Token={quote(credentials.token, safe='')}" if credentials.token else ""
    return f"{address.scheme}://{address.netloc}{address.path}?{urlsplit(str(request.url)).query}{token}"
