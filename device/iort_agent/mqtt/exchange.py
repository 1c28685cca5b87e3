"""The connection with a provisioning claim, and the two requests that exchange it for a certificate."""

from __future__ import annotations

import threading
import uuid
from typing import Any, Mapping

from iort_agent.errors import IdentityError, RefusedError
from iort_agent.identity.certificate import check_pair
from iort_agent.identity.claim import Claim
from iort_contract.cloud import claim_name, fleet_name

_WAIT_S = 30.0


class _Connection:
    """A connection to the broker that does not reconnect."""

    def __init__(self, claim: Claim, certificate: bytes, private_key: bytes, client_id: str) -> None:
        # Reading a configuration must not need the network's library.
        from awscrt import mqtt5  # noqa: PLC0415 - see above
        from awsiot import mqtt5_client_builder  # noqa: PLC0415 - as above

        self._ended = threading.Event()
        self._stopped = threading.Event()
        self._connected = False
        self.failure = "no answer"
        self.client: Any = mqtt5_client_builder.mtls_from_bytes(
            certificate,
            private_key,
            endpoint=claim.endpoint,
            port=claim.port,
            ca_filepath=None if claim.root_ca is None else str(claim.root_ca),
            client_id=client_id,
            session_behavior=mqtt5.ClientSessionBehaviorType.CLEAN,
            min_reconnect_delay_ms=60_000,
            max_reconnect_delay_ms=60_000,
            on_lifecycle_connection_success=self._on_success,
            on_lifecycle_connection_failure=self._on_failure,
            on_lifecycle_stopped=lambda _: self._stopped.set(),
        )

    def open(self) -> bool:
        """Connect; whether the broker accepted."""
        self.client.start()
        return self._ended.wait(_WAIT_S) and self._connected

    def close(self) -> None:
        """Disconnect, or give up connecting."""
        self.client.stop()
        self._stopped.wait(_WAIT_S)

    def _on_success(self, _: Any) -> None:
        self._connected = True
        self._ended.set()

    def _on_failure(self, data: Any) -> None:
        from iort_agent.mqtt.failures import explain, said  # noqa: PLC0415 - it loads the network's library

        packet = data.connack_packet
        self.failure = said(packet) if packet is not None else explain(data.exception)
        self._ended.set()


class Exchange:
    """The connection with a claim, open within a `with`."""

    def __init__(self, claim: Claim) -> None:
        """Raises `IdentityError`, which says which of the claim's files does not fit."""
        try:
            # The library's own error names no file.
            check_pair(claim.certificate, claim.private_key)
        except IdentityError as error:
            raise IdentityError(f"the claim: {error}") from error
        self._claim = claim
        self._template = fleet_name(claim.namespace)
        self._connection = _Connection(
            claim,
            claim.certificate.read_bytes(),
            claim.private_key.read_bytes(),
            f"{claim_name(claim.namespace)}-{uuid.uuid4().hex[:8]}",
        )
        self._requests: Any = None

    def __enter__(self) -> Exchange:  # noqa: PYI034 - Self came with Python 3.11
        from awscrt import mqtt_request_response  # noqa: PLC0415 - the network's library
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        if not self._connection.open():
            self.__exit__()
            raise IdentityError(
                f"the claim does not connect: {self._connection.failure}. Most claims live for minutes "
                "only: ask the operator for a new one (`iort robots claim`)"
            )
        options = mqtt_request_response.ClientOptions(
            max_request_response_subscriptions=4, max_streaming_subscriptions=0
        )
        options.operation_timeout_in_seconds = int(_WAIT_S)
        self._requests = iotidentity.IotIdentityClientV2(self._connection.client, options)
        return self

    def __exit__(self, *_: object) -> None:
        self._requests = None
        self._connection.close()

    def certify(self, request: str) -> tuple[str, str]:
        """Returns the certificate for a signing request, and the token that proves its ownership."""
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        asked = iotidentity.CreateCertificateFromCsrRequest(certificate_signing_request=request)
        answer = _result("CreateCertificateFromCsr", self._requests.create_certificate_from_csr(asked))
        return str(answer.certificate_pem), str(answer.certificate_ownership_token)

    def register(self, token: str, parameters: Mapping[str, str]) -> str:
        """Register the robot with its certificate. Returns the thing's name."""
        from awsiot import iotidentity  # noqa: PLC0415 - the network's library

        asked = iotidentity.RegisterThingRequest(
            template_name=self._template,
            certificate_ownership_token=token,
            parameters=dict(parameters),
        )
        return str(_result("RegisterThing", self._requests.register_thing(asked)).thing_name)

    def connects(self, robot: str, certificate: str, private_key: str) -> bool:
        """Whether the broker accepts the robot with this certificate, which it does once it is registered.

        It ends a session that the robot has, as the robot's agent would.
        """
        connection = _Connection(self._claim, certificate.encode(), private_key.encode(), robot)
        try:
            return connection.open()
        finally:
            connection.close()


def _result(what: str, future: Any) -> Any:
    try:
        return future.result(_WAIT_S + 5)
    except Exception as error:
        modeled = getattr(error, "modeled_error", None)
        if modeled is None:
            raise IdentityError(f"{what} was refused: {error}") from error
        code = str(modeled.error_code)
        raise RefusedError(f"{what} was refused: {code}: {modeled.error_message}", code) from error
