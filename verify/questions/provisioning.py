"""Provisioning: from a claim to a robot's certificate, by the agent's own code."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from iort_agent.errors import IdentityError
from iort_agent.verbs import provision
from iort_agent.verbs.registration import Exchange, load_claim, make_key
from iort_contract.cloud import fleet_name
from iort_contract.tables import (
    ADMIT_CLAIM,
    ADMIT_FINGERPRINT,
    ADMITTED_CERTIFICATE,
    ROBOT_PARAMETER,
    SERIAL_PARAMETER,
)
from iort_station.fleet import identity, registry
from testkit.mqtt import refusal
from testkit.target import Target
from testkit.waiting import InstrumentError
from verify.question import Seen, question
from verify.tools import removed_after

_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"
_HOOK = f"{_GUIDE}/pre-provisioning-hook.html"
_PROVISION = f"{_GUIDE}/provision-wo-cert.html"
_REFUSED = re.compile(r"RegisterThing was refused: (\w+)")
_OPEN_S = 600
_SERIAL = "verify"


_MADE = {
    "refused": "",
    "thing_type_is_the_fleets": True,
    "attributes": ["serial", "vehicle"],
    "certificates": ["ACTIVE"],
    "name_is_closed_again": True,
    "connects": True,
}


class _RefusedError(InstrumentError):
    """RegisterThing was refused; the error's text is the code."""


@contextmanager
def _agent() -> Iterator[None]:
    """Run the agent's code; its errors become this package's error."""
    try:
        yield
    except IdentityError as error:
        if code := _REFUSED.search(str(error)):
            raise _RefusedError(code[1]) from error
        raise InstrumentError(str(error)) from error


def _provision(file: Path, robot: str | None = None) -> str:
    """The code with which RegisterThing is refused; "" if it succeeds."""
    try:
        with _agent():
            provision.provision(file, robot=robot)
    except _RefusedError as error:
        return str(error)
    return ""


def _claim(target: Target, robot: str | None, folder: Path, *, lasting: bool = False) -> Path:
    """A claim's file with a serial number: not every machine here has one."""
    file = identity.claim(target.cloud, robot, out=folder, lasting=lasting)
    file.write_text(file.read_text() + yaml.safe_dump({"serial": _SERIAL}))
    return file


def _made(target: Target, robot: str, folder: Path, file: Path) -> dict[str, Any]:
    """The result of a robot's provisioning."""
    if refused := _provision(file, robot):
        return {"refused": refused}
    thing = target.cloud.client("iot").describe_thing(thingName=robot)
    return {
        "refused": "",
        "thing_type_is_the_fleets": thing.get("thingTypeName") == fleet_name(target.cloud.namespace),
        "attributes": sorted(thing["attributes"]),
        "certificates": [one.status for one in identity.certificates(target.cloud, robot)],
        "name_is_closed_again": ADMITTED_CERTIFICATE in registry.get(target.cloud, robot),
        "connects": refusal(folder) is None,
    }


@question(
    "provisioning.claim_for_minutes",
    expected=_MADE,
    source=f"{_PROVISION} and {_HOOK}",
    relied_on_by=(
        "station/iort_station/fleet/identity.py",
        "functions/admit.py",
        "device/iort_agent/verbs/provision.py",
        "stacks/fleet.py",
        "local/patches/certificate_from_csr.patch",
    ),
)
def claim_for_minutes(target: Target) -> Seen:
    """A claim of CreateProvisioningClaim is exchanged for a certificate of the robot's own key. The hook
    admits it, and the template creates the thing and attaches certificate and policy."""
    with removed_after(target, "verify-own-claim") as (name, folder):
        return _made(target, name, folder, _claim(target, name, folder))


@question(
    "provisioning.claim_that_lasts",
    expected=_MADE,
    source=f"{_PROVISION} and {_HOOK}",
    relied_on_by=(
        "station/iort_station/fleet/identity.py",
        "functions/admit.py",
        "stacks/fleet.py",
    ),
)
def claim_that_lasts(target: Target) -> Seen:
    """A claim certificate with the fleet's claim policy is exchanged in the same way."""
    with removed_after(target, "verify-lasting-claim") as (name, folder):
        file = _claim(target, None, folder, lasting=True)
        try:
            identity.register(target.cloud, name, days=1)
            return _made(target, name, folder, file)
        finally:
            identity.revoke_claims(target.cloud)


@question(
    "provisioning.claim_known_by",
    expected={"by_one_of_both": True},
    relied_on_by=("functions/admit.py", "station/iort_station/fleet/registry.py"),
)
def claim_known_by(target: Target) -> Seen:
    """The hook's claimCertificateId is the id of CreateProvisioningClaim or the SHA-256 of its certificate.
    AWS does not document which; both are accepted."""
    # Open one name for the claim's id alone, and another for its fingerprint alone.
    nobody, seen = "0" * 64, {}
    for which in (ADMIT_CLAIM, ADMIT_FINGERPRINT):
        with removed_after(target, f"verify-by-{which}") as (name, folder):
            file = _claim(target, name, folder)
            row = registry.get(target.cloud, name)
            known = {ADMIT_CLAIM: nobody, ADMIT_FINGERPRINT: nobody, which: row[which]}
            by = registry.ClaimId(known[ADMIT_CLAIM], known[ADMIT_FINGERPRINT])
            registry.open_name(target.cloud, name, for_s=_OPEN_S, claim=by)
            seen[which] = not _provision(file)
    return {
        "by_one_of_both": any(seen.values()),
        "note_by_the_id": seen[ADMIT_CLAIM],
        "note_by_the_fingerprint": seen[ADMIT_FINGERPRINT],
    }


@question(
    "provisioning.registered_again",
    expected={"first_is_its_own": True, "again_refused": "", "certificates": ["ACTIVE"]},
    relied_on_by=("device/iort_agent/verbs/provision.py", "functions/admit.py"),
)
def registered_again(target: Target) -> Seen:
    """RegisterThing with the same certificate and token succeeds again: the agent retries after a lost
    first answer."""
    # RegisterThing twice, like the agent after a lost first answer.
    with removed_after(target, "verify-again") as (name, folder):
        claim = load_claim(_claim(target, name, folder))
        _, request = make_key(name)
        parameters = {ROBOT_PARAMETER: name, SERIAL_PARAMETER: _SERIAL}
        with _agent(), Exchange(claim) as exchange:
            _, token = exchange.certify(request)
            first = exchange.register(token, parameters)
            code = ""
            try:
                with _agent():
                    exchange.register(token, parameters)
            except _RefusedError as error:
                code = str(error)
        held = identity.certificates(target.cloud, name)
    return {
        "first_is_its_own": first == name,
        "again_refused": code,
        "certificates": [one.status for one in held],
    }


@question(
    "provisioning.name_taken",
    expected={"first": "", "second_is_refused": True, "certificates": 1},
    source=_HOOK,
    relied_on_by=("functions/admit.py",),
)
def name_taken(target: Target) -> Seen:
    """The hook refuses a second certificate for a taken name, and RegisterThing fails with it; the
    certificate is not attached."""
    with removed_after(target, "verify-taken") as (name, folder):
        file = _claim(target, name, folder)
        first, second = _provision(file), _provision(file)
        held = identity.certificates(target.cloud, name)
    return {"first": first, "second_is_refused": bool(second), "certificates": len(held), "note_code": second}
