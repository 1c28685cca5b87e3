"""The operator's cloud: an AWS account, or an embedded cloud of this machine.

It provides clients of AWS' services, the outputs of the stacks, and the address for robots.
"""

from __future__ import annotations

import json
import os
import shlex
import socket
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, overload
from urllib.parse import urlsplit

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.limits import DEFAULT_NAMESPACE
from iort_station import kept
from iort_station.errors import StationError
from iort_station.output import write_private

if TYPE_CHECKING:
    import boto3
    from types_boto3_dynamodb import DynamoDBClient
    from types_boto3_iot import IoTClient
    from types_boto3_iot_data import IoTDataPlaneClient
    from types_boto3_s3 import S3Client
    from types_boto3_sqs import SQSClient
    from types_boto3_ssm import SSMClient

# The embedded cloud's description, relative to the checkout.
EMBEDDED = Path("build/local/cloud.json")
# The environment variable with the path of such a file.
EMBEDDED_VARIABLE = "IORT_EMBEDDED"

# Who has set one of these wants an AWS account.
AWS_NAMED = ("AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION", "AWS_ACCESS_KEY_ID")
# An embedded cloud runs on this machine.
_CONNECT_S = 5.0
# An embedded cloud has its own credentials; the profile in AWS_PROFILE may not exist.
_NO_PROFILE = {"profile": (None, None, None, None)}


def find_embedded(folder: Path) -> Path | None:
    """The file of the embedded cloud that runs in the checkout around ``folder``; None if none runs."""
    places = (each / EMBEDDED for each in (folder, *folder.parents))
    return next((place for place in places if place.is_file()), None)


def embedded_here() -> Path | None:
    """The file of the embedded cloud that a command means which names none: that of the checkout around this
    folder, or else that of `make up`; None if neither runs."""
    up = kept.folder() / kept.CLOUD
    return find_embedded(Path.cwd()) or (up if up.is_file() else None)


def _running() -> str:
    """The embedded clouds that this user runs, as advice."""
    files = kept.running()
    named = "; ".join(f"iort --embedded {shlex.quote(str(file))}" for file in files)
    return f"These run: {named}" if files else "`make up` or `make demo` starts one"


def without_proxy(host: str) -> None:
    """Exclude ``host`` from the proxies of this process' libraries."""
    known = os.environ.get("no_proxy") or os.environ.get("NO_PROXY", "")
    if host and host not in known.split(","):
        os.environ["no_proxy"] = os.environ["NO_PROXY"] = f"{known},{host}".lstrip(",")


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """A deployment of the stacks. boto3 finds region and credentials by its usual chain where these are
    empty."""

    namespace: str = DEFAULT_NAMESPACE
    region: str | None = None
    profile: str | None = None
    endpoint_url: str | None = None
    ca_bundle: str | None = None
    access_key_id: str | None = None
    secret_access_key: str | None = field(default=None, repr=False)
    mqtt_host: str | None = None
    mqtt_port: int = 8883
    root_ca_pem: str | None = None
    # A browser does not trust the embedded cloud's authority; this address has no TLS, and is on loopback.
    websocket: str | None = None
    # Where the embedded cloud's page is served on this machine, with a slash at the end.
    page: str | None = None

    _calls: ClassVar[dict[str, Any]] = {
        "retries": {"mode": "standard", "max_attempts": 5},
        "connect_timeout": 5,
        "read_timeout": 20,
    }

    @classmethod
    def find(
        cls,
        *,
        namespace: str = DEFAULT_NAMESPACE,
        profile: str | None = None,
        region: str | None = None,
        local: bool = False,
        embedded: Path | None = None,
        say: Callable[[str], object] = lambda _line: None,
    ) -> Cloud:
        """The cloud that `iort` means, here and with these options: an embedded one that runs here, unless an
        option or a variable of the environment selects AWS. ``say`` takes a line with the choice.

        Raises `StationError` if none runs and AWS' credentials are missing.
        """
        aws_named = profile or region or any(os.environ.get(name) for name in AWS_NAMED)
        if embedded is None and (named := os.environ.get(EMBEDDED_VARIABLE)):
            embedded = Path(named)
        file = embedded or embedded_here()
        if local and file is None:
            raise StationError(
                f"no embedded cloud is running: {Path.cwd()} and the folders above it have no {EMBEDDED}, "
                f"and {kept.folder()} no {kept.CLOUD}. --embedded or {EMBEDDED_VARIABLE} names its file from "
                f"anywhere else. {_running()}"
            )
        if file and (local or (not aws_named and file.exists())):
            cloud = cls.load(file).answering(file)
            if not local:
                say(f"on the embedded cloud of {file}")
            return cloud
        cloud = cls(namespace=namespace, profile=profile, region=region)
        try:
            cloud.check()
        except StationError as error:
            if aws_named:
                raise
            raise StationError(f"{error}. No embedded cloud runs here either. {_running()}") from error
        say(f"on AWS, in {cloud.region_name}{f' with the profile {profile}' if profile else ''}")
        return cloud

    def answering(self, file: Path) -> Cloud:
        """Return itself; raises `StationError` if this embedded cloud has ended without removing its file."""
        if self.endpoint_url is None:
            return self
        address = urlsplit(self.endpoint_url)
        try:
            socket.create_connection((address.hostname or "", address.port or 0), _CONNECT_S).close()
        except OSError as error:
            raise StationError(
                f"the embedded cloud of {file} does not answer: was it killed? `make up` or `make "
                "demo` starts one"
            ) from error
        return self

    @classmethod
    def load(cls, path: Path) -> Cloud:
        """The embedded cloud that wrote ``path``; raises `StationError` if none is running."""
        try:
            cloud = cls(**json.loads(path.read_text()))
        except FileNotFoundError as error:
            raise StationError(f"no embedded cloud is running: {path} does not exist") from error
        except (OSError, TypeError, ValueError) as error:
            raise StationError(f"{path} must describe an embedded cloud: {error}") from error
        without_proxy(urlsplit(cloud.endpoint_url or "").hostname or "")
        return cloud

    def save(self, path: Path) -> None:
        """Write the file that `load` reads, whole at any moment; it has a secret."""
        write_private(path, json.dumps(asdict(self)))

    @cached_property
    def _session(self) -> boto3.Session:
        # Its import takes longer than `iort --help` may.
        import boto3  # noqa: PLC0415 - see above
        import botocore.session  # noqa: PLC0415 - see above

        return boto3.Session(
            botocore_session=None if self.access_key_id is None else botocore.session.Session(_NO_PROFILE),
            profile_name=self.profile,
            # boto3 reads only AWS_DEFAULT_REGION, unlike AWS' other tools.
            region_name=self.region or os.environ.get("AWS_REGION"),
            aws_access_key_id=self.access_key_id,
            aws_secret_access_key=self.secret_access_key,
        )

    def urgent(self) -> Cloud:
        """The same cloud with clients of its own, which give up within seconds: for a stop, which must not
        wait for what else is asked of the cloud."""
        return _Urgent(**{each.name: getattr(self, each.name) for each in fields(self)})

    def check(self) -> Cloud:
        """Return itself; raises `StationError` if profile, region or credentials are missing."""
        try:
            region, credentials = self._session.region_name, self._session.get_credentials()
        except BotoCoreError as error:
            raise StationError(f"AWS: {error}") from error
        if not region:
            raise StationError("no AWS region: give --region, or set AWS_REGION")
        if credentials is None:
            raise StationError(
                "no AWS credentials: give --profile, or set AWS_PROFILE, or AWS_ACCESS_KEY_ID and "
                "AWS_SECRET_ACCESS_KEY; `aws configure` writes a profile"
            )
        return self

    @cached_property
    def _clients(self) -> dict[tuple[str, str | None], Any]:
        return {}

    @overload
    def client(self, service: Literal["dynamodb"], region: str | None = None) -> DynamoDBClient: ...
    @overload
    def client(self, service: Literal["iot"], region: str | None = None) -> IoTClient: ...
    @overload
    def client(self, service: Literal["iot-data"], region: str | None = None) -> IoTDataPlaneClient: ...
    @overload
    def client(self, service: Literal["s3"], region: str | None = None) -> S3Client: ...
    @overload
    def client(self, service: Literal["sqs"], region: str | None = None) -> SQSClient: ...
    @overload
    def client(self, service: Literal["ssm"], region: str | None = None) -> SSMClient: ...
    @overload
    def client(self, service: str, region: str | None = None) -> Any: ...
    def client(self, service: str, region: str | None = None) -> Any:
        """A cached boto3 client; ``region`` is for services that few regions have.

        Raises `StationError` if region or credentials are missing.
        """
        key = service, region
        # A session makes one client at a time; a client may be used from several threads. A stop has a cloud
        # of its own, and so waits for nobody here.
        with vars(self).setdefault("_making", threading.Lock()):
            if key not in self._clients:
                self._clients[key] = self._new_client(service, region)
        return self._clients[key]

    def _new_client(self, service: str, region: str | None) -> Any:
        from botocore.config import Config  # noqa: PLC0415 - as above

        try:
            client = self._session.client(  # type: ignore[call-overload]  # any service's name
                service,
                region_name=region,
                endpoint_url=self.endpoint_url,
                verify=self.ca_bundle,
                config=Config(
                    **self._calls,
                    # botocore's own text is made anew for each request, in a tenth of a millisecond.
                    user_agent="iort",
                ),
            )
        except BotoCoreError as error:
            raise StationError(f"no AWS client for {service}: {error}") from error
        if service == "dynamodb":
            from iort_contract.dynamodb import quick  # noqa: PLC0415 - as above

            quick(client)
        return client

    @property
    def region_name(self) -> str | None:
        """The region that boto3 finds."""
        found = self._session.region_name
        return None if found is None else str(found)

    @cached_property
    def mqtt_endpoint(self) -> str:
        """The host that robots connect to."""
        if self.mqtt_host:
            return self.mqtt_host
        answer = self.client("iot").describe_endpoint(endpointType="iot:Data-ATS")
        return str(answer["endpointAddress"])

    @property
    def websocket_url(self) -> str:
        """Where a browser connects to the broker: MQTT over WebSocket."""
        return self.websocket or f"wss://{self.mqtt_endpoint}/mqtt"

    def find_output(self, noun: str, name: str) -> str | None:
        """An output of a stack that not every deployment has; None without it. Raises `StationError`."""
        return self._stack_outputs(noun).get(name)

    def output(self, noun: str, name: str) -> str:
        """An output of a stack, such as ``("storage", "TelemetryTable")``; raises `StationError`."""
        outputs = self._stack_outputs(noun)
        if name not in outputs:
            stack = f"{self.namespace}-{noun}"
            raise StationError(f"stack {stack} has no output {name}; deploy the current stacks")
        return outputs[name]

    def _stack_outputs(self, noun: str) -> dict[str, str]:
        stack = f"{self.namespace}-{noun}"
        try:
            return _outputs(self.client("cloudformation"), stack)
        except ClientError as error:
            if error.response["Error"]["Code"] != "ValidationError":
                raise StationError(f"stack {stack} cannot be read: {error}") from error
            raise StationError(
                f"stack {stack} is not deployed in {self._session.region_name}: run `make deploy`, or choose "
                "another --region or --namespace"
            ) from error
        except BotoCoreError as error:
            raise StationError(f"stack {stack} cannot be read: {error}") from error


def invoke(cloud: Cloud, noun: str, function: str, event: bytes, called: str) -> bytes:
    """A function's answer to an event; ``function`` is the output of the stack that names it.

    Raises `StationError` if it fails, by the name ``called``.
    """
    reply = cloud.client("lambda").invoke(FunctionName=cloud.output(noun, function), Payload=event)
    answer: bytes = reply["Payload"].read()
    if "FunctionError" in reply:
        raise StationError(f"{called} failed: {json.loads(answer).get('errorMessage', answer[:500])}")
    return answer


class _Urgent(Cloud):
    _calls: ClassVar[dict[str, Any]] = {
        "retries": {"mode": "standard", "max_attempts": 2},
        "connect_timeout": 2,
        "read_timeout": 3,
        # A fleet is stopped at once.
        "max_pool_connections": 32,
    }


@cache
def _outputs(cloudformation: Any, stack: str) -> dict[str, str]:
    described = cloudformation.describe_stacks(StackName=stack)["Stacks"][0]
    return {output["OutputKey"]: output["OutputValue"] for output in described.get("Outputs", [])}
