"""Provisioning: from a claim to a robot's certificate, by the agent's own code."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
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
from testkit.waiting import InstrumentError
from verify.lab import Lab
from verify.question import Seen, question

_REFUSED = re.compile(r"RegisterThing was refused: (\w+)")
_OPEN_S = 600
_SERIAL = "verify"
_DONE = {
    "refused": "",
    "thing_type_is_the_fleets": True,
    "attributes": ["serial", "vehicle"],
    "certificates": ["ACTIVE"],
    "name_is_closed_again": True,
    "connects": True,
}


def _refused(exchange: Callable[[], object]) -> str:
    """The code with which RegisterThing is refused by the agent's code; "" if it succeeds."""
    try:
        exchange()
    except IdentityError as error:
        if code := _REFUSED.search(str(error)):
            return code[1]
        raise InstrumentError(str(error)) from error
    return ""


def _claim(lab: Lab, robot: str | None, folder: Path, *, lasting: bool = False) -> Path:
    """A claim's file with a serial number: not every machine here has one."""
    file = identity.claim(lab.cloud, robot, out=folder, lasting=lasting)
    file.write_text(file.read_text() + yaml.safe_dump({"serial": _SERIAL}))
    return file


def _certificates(lab: Lab, robot: str) -> list[str]:
    """The states of a robot's certificates."""
    return [certificate.status for certificate in identity.certificates(lab.cloud, robot)]


def _provisioned(lab: Lab, robot: str, folder: Path, file: Path) -> dict[str, Any]:
    """The result of a robot's provisioning."""
    if refused := _refused(partial(provision.provision, file, robot=robot)):
        return {"refused": refused}
    thing = lab.client("iot").describe_thing(thingName=robot)
    return {
        "refused": "",
        "thing_type_is_the_fleets": thing.get("thingTypeName") == fleet_name(lab.namespace),
        "attributes": sorted(thing["attributes"]),
        "certificates": _certificates(lab, robot),
        "name_is_closed_again": ADMITTED_CERTIFICATE in registry.get(lab.cloud, robot),
        "connects": refusal(folder) is None,
    }


@question(
    "provisioning.claim_for_minutes",
    aws="iot:provision-wo-cert iot:pre-provisioning-hook",
    expected=_DONE,
)
def claim_for_minutes(lab: Lab) -> Seen:
    """A claim of CreateProvisioningClaim is exchanged for a certificate of the robot's own key. The hook
    admits it, and the template creates the thing and attaches certificate and policy."""
    name, folder = lab.removed_after("verify-own-claim")
    return _provisioned(lab, name, folder, _claim(lab, name, folder))


@question(
    "provisioning.claim_that_lasts",
    aws="iot:provision-wo-cert iot:pre-provisioning-hook",
    expected=_DONE,
)
def claim_that_lasts(lab: Lab) -> Seen:
    """A claim certificate with the fleet's claim policy is exchanged in the same way."""
    name, folder = lab.removed_after("verify-lasting-claim")
    file = _claim(lab, None, folder, lasting=True)
    lab.undo(identity.revoke_claims, lab.cloud)
    identity.register(lab.cloud, name, days=1)
    return _provisioned(lab, name, folder, file)


@question(
    "provisioning.claim_known_by",
    expected={"by_one_of_both": True},
)
def claim_known_by(lab: Lab) -> Seen:
    """The hook's claimCertificateId is the id of CreateProvisioningClaim or the SHA-256 of its certificate.
    AWS does not document which; both are accepted."""
    # Open one name for the claim's id alone, and another for its fingerprint alone.
    nobody, known = "0" * 64, dict[str, bool]()
    for which in (ADMIT_CLAIM, ADMIT_FINGERPRINT):
        name, folder = lab.removed_after(f"verify-by-{which}")
        file = _claim(lab, name, folder)
        ids = {ADMIT_CLAIM: nobody, ADMIT_FINGERPRINT: nobody, which: registry.get(lab.cloud, name)[which]}
        claim = registry.ClaimId(ids[ADMIT_CLAIM], ids[ADMIT_FINGERPRINT])
        registry.open_name(lab.cloud, name, for_s=_OPEN_S, claim=claim)
        known[which] = not _refused(partial(provision.provision, file, robot=None))
    return {
        "by_one_of_both": any(known.values()),
        "note_by_the_id": known[ADMIT_CLAIM],
        "note_by_the_fingerprint": known[ADMIT_FINGERPRINT],
    }


@question(
    "provisioning.registered_again",
    expected={"first_is_its_own": True, "again_refused": "", "certificates": ["ACTIVE"]},
)
def registered_again(lab: Lab) -> Seen:
    """RegisterThing with the same certificate and token succeeds again: the agent retries after a lost
    first answer."""
    name, folder = lab.removed_after("verify-again")
    claim, (_, request) = load_claim(_claim(lab, name, folder)), make_key(name)
    parameters = {ROBOT_PARAMETER: name, SERIAL_PARAMETER: _SERIAL}
    try:
        with Exchange(claim) as exchange:
            _, token = exchange.certify(request)
            first = exchange.register(token, parameters)
            refused = _refused(partial(exchange.register, token, parameters))
    except IdentityError as error:
        raise InstrumentError(str(error)) from error
    own, certificates = first == name, _certificates(lab, name)
    return {"first_is_its_own": own, "again_refused": refused, "certificates": certificates}


@question(
    "provisioning.name_taken",
    aws="iot:pre-provisioning-hook",
    expected={"first": "", "second_is_refused": True, "certificates": 1},
)
def name_taken(lab: Lab) -> Seen:
    """The hook refuses a second certificate for a taken name, and RegisterThing fails with it; the
    certificate is not attached."""
    name, folder = lab.removed_after("verify-taken")
    file = _claim(lab, name, folder)
    first, second = (_refused(partial(provision.provision, file, robot=None)) for _ in range(2))
    certificates = len(_certificates(lab, name))
    return {
        "first": first,
        "second_is_refused": bool(second),
        "certificates": certificates,
        "note_code": second,
    }
