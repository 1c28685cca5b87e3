"""Findings survive JSON, and anything else is refused."""

from __future__ import annotations

import json

import pytest

from iort_contract.catalog.analysis import KINDS, PARAMETERS
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import DriveKey, Estimate, Finding, decode_finding, encode_finding

FINDING = Finding(
    drive=DriveKey("car7", 1_700_000_000_000_000, "00c0ffee"),
    kind="battery_worn",
    severity="warning",
    subject="battery_resistance_ohm",
    from_us=1_700_000_000_000_000,
    to_us=1_700_000_060_000_000,
    stream="vesc",
    fields=("voltage_input", "current_input"),
    text="the internal resistance has grown",
    effect=Estimate(0.03, 0.02, 0.04, "ohm"),
    p=0.001,
)


def test_a_finding_survives_json() -> None:
    assert decode_finding(json.loads(json.dumps(encode_finding(FINDING)))) == FINDING


@pytest.mark.parametrize(
    "change",
    [
        {"fields": "voltage_input"},
        {"p": "small"},
        {"p": 10**400},
        {"effect": {"value": 1}},
        {"kind": 7},
        {"run": None},
    ],
)
def test_what_is_no_finding_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ContractError):
        decode_finding({**encode_finding(FINDING), **change})


def test_a_whole_number_is_a_float_too() -> None:
    assert repr(decode_finding({**encode_finding(FINDING), "p": 0}).p) == "0.0"


def test_every_parameter_names_a_kind_that_exists() -> None:
    assert {parameter.kind for parameter in PARAMETERS.values()} - {""} <= KINDS.keys()
