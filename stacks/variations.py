"""Settings that the checks synthesize besides the defaults, to check every form.

`make check` lints every one of them, and tests/stacks updates, measures and deploys them.
"""

from __future__ import annotations

from typing import Any

from iort_contract.cloud import PUBNUB
from stacks.settings import ALL_LOGS, PROD

# Parameters with two values each, to change and to change back; the base has every default. Settings that
# only change properties of different resources change together: an app takes seconds to synthesize.
FLIPS: dict[str, dict[str, Any]] = {
    "stage": {"stage": PROD},
    "mail": {"alarm_email": "lab@example.org"},
    "budget": {"budget_usd": 50, "alarm_email": "lab@example.org"},
    "kept key": {"keep_customer_key": True},
    "account": {"device_defender": True, "iot_log_level": "error"},
    "site": {"site": True, "site_robots": ["car1"]},
    "drivers": {"drivers": True},
    "turn": {"turn": True},
    "PubNub": {"live_transport": PUBNUB},
    "no nightly analysis": {"nightly_analysis": False},
    "properties": {
        "retention_days": 7,
        "archive": False,
        "files_days": 30,
        "fleet_robots": 5,
        "record_gb_a_day": 1,
        "upload_gb_a_day": 5,
        "live_concurrency": 5,
        "account_concurrency": 1000,
        "robot_metrics": True,
        "function_logs": ALL_LOGS,
        "tags": {"team": "lab"},
        "incident_mails": False,
        "low_voltage_v": 13.2,
        "high_temperature_degc": 70.0,
        "stream_behind_s": 30.0,
        "car_to_lambda_ms": 1_000.0,
        "page_url": "https://page.example.org/",
    },
}
KEY: dict[str, Any] = {"customer_key": True}
# Another namespace is another deployment, and so is the embedded cloud; the layers are folders.
NOT_FLIPPED = {"namespace", "embedded", "layer", "analysis_layer"}
# The longest that the contract allows; resource names contain it.
LONGEST_NAMESPACE = "n" * 16
EVERYTHING: dict[str, Any] = {
    **{name: value for flip in FLIPS.values() for name, value in flip.items()},
    **KEY,
    # The function Live is one of the resources.
    "live_transport": PUBNUB,
}
# `keep_customer_key` has no effect beside `customer_key`.
VARIATIONS: dict[str, dict[str, Any]] = {
    "default": {},
    **FLIPS,
    "key": KEY,
    "everything": EVERYTHING,
    "longest names": {**EVERYTHING, "namespace": LONGEST_NAMESPACE},
}
