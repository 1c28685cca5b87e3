"""Registers a robot with AWS IoT: a key, its certificate and the thing, resumed after any interruption."""

from __future__ import annotations

import logging
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Callable

from iort_agent.errors import IdentityError, RefusedError
from iort_agent.identity.claim import Claim
from iort_agent.identity.machine_key import machine_serial, make_key
from iort_agent.identity.pending import Pending, keep, kept
from iort_agent.mqtt.exchange import Exchange
from iort_contract.tables import ROBOT_PARAMETER, SERIAL_PARAMETER

_log = logging.getLogger(__name__)

# Waits before each further try to register.
_AGAIN_S = (1.0, 4.0)
# How AWS IoT's error codes begin for a token or a certificate that is no longer valid.
_NO_LONGER = ("Invalid", "ResourceNotFound")
# The characters that RegisterThing allows in a parameter and a thing in an attribute.
_SERIAL = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,800}")


@dataclass(frozen=True)
class Seams:
    """Replaced by tests: the claim's connection, and waiting."""

    exchange: Callable[[Claim], Exchange] = Exchange
    wait: Callable[[float], None] = time.sleep


SEAMS = Seams()


def register(claim: Claim, robot: str, folder: Path, seams: Seams) -> Pending:
    """A key and its certificate, registered for the robot's thing: those of an earlier run that was stopped,
    or new ones. `pending` keeps them in the folder until `forget`."""
    serial = claim.serial or machine_serial()
    if not _SERIAL.fullmatch(serial):
        raise IdentityError(f"serial must be of A-Z a-z 0-9 _ . , @ / : # -, got {serial!r}")
    earlier = kept(folder)
    if earlier is not None and earlier.is_for(robot, serial, claim.endpoint, claim.namespace):
        if _finish(claim, earlier, seams):
            return earlier
        _log.warning("the certificate of an earlier run is no longer valid: requesting another")
    key, request = make_key(robot)
    with seams.exchange(claim) as connection:
        certificate, token = connection.certify(request)
        asked_s = time.time()
        issued = Pending(robot, serial, claim.endpoint, claim.namespace, key, certificate, token, asked_s)
        keep(folder, issued)
        _ask(connection, issued, seams)
    return issued


def _finish(claim: Claim, earlier: Pending, seams: Seams) -> bool:
    """Register an earlier run's certificate; False if it can never be registered.

    Raises `IdentityError` if it may be registered later: whom the hook refuses now, it refuses with any
    certificate.
    """
    expired = not earlier.may_register(time.time())
    try:
        # Without a network no certificate connects. So request another one only while the claim connects.
        with seams.exchange(claim) as connection:
            if expired:
                return _is_registered(connection, earlier)
            _ask(connection, earlier, seams)
    except IdentityError as error:
        if _is_no_longer_good(error):
            return False
        # The claim may have expired meanwhile.
        if not _is_registered(seams.exchange(claim), earlier):
            raise
    return True


def _ask(connection: Exchange, issued: Pending, seams: Seams) -> None:
    parameters = {ROBOT_PARAMETER: issued.robot, SERIAL_PARAMETER: issued.serial}
    try:
        thing = register_again(lambda: connection.register(issued.token, parameters), wait=seams.wait)
    except IdentityError:
        # The answer may have been lost. AWS does not document the answer to a used token.
        if not _is_registered(connection, issued):
            raise
        return
    if thing != issued.robot:
        raise IdentityError(f"the cloud registered {thing}, not {issued.robot}: its template is not ours")


def _is_registered(connection: Exchange, issued: Pending) -> bool:
    return connection.connects(issued.robot, issued.certificate, issued.private_key)


def _is_no_longer_good(error: IdentityError) -> bool:
    return isinstance(error, RefusedError) and error.code.startswith(_NO_LONGER)


def register_again(register: Callable[[], str], *, wait: Callable[[float], None]) -> str:
    """Register, with a few tries while the token may be valid.

    AWS IoT gives the fleet's hook 5 s. A hook that was too late has given the name to this certificate, and
    for a while admits no other. Raises the first `IdentityError` if all tries fail.
    """
    first: IdentityError | None = None
    for wait_s in (*_AGAIN_S, None):
        try:
            return register()
        except IdentityError as error:  # noqa: PERF203 - it waits for seconds
            first = first or error
            if _is_no_longer_good(error):
                break
            if wait_s is not None:
                _log.warning("%s; trying again in %g s", error, wait_s)
                wait(wait_s)
    assert first is not None
    raise first
