"""The message reference has every limit of the contract with its value."""

from __future__ import annotations

from ministack.services import iot

from functions import live
from functions.shared import seconds
from iort_agent.mqtt import rate_limiter
from iort_contract import limits
from iort_contract.messages import commands, files, questions
from iort_contract.messages import live as viewing
from iort_contract.ros1.message import MAX_LAYOUT
from stacks.settings import Settings
from tests.messages_page import PAGE, named, rows, section

# Limits that the page writes with a unit; all others are plain numbers.
UNITS: dict[str, tuple[int, str]] = {
    **dict.fromkeys(("MAX_MESSAGE_BYTES", "MAX_PUBNUB_BYTES", "MAX_INLINE_BYTES"), (1024, "KiB")),
    **dict.fromkeys(("MAX_COLUMNS_BYTES", "MAX_SERIALIZED_BYTES", "PART_BYTES"), (2**20, "MiB")),
    "MAX_FILE_BYTES": (2**30, "GiB"),
    "MAX_BATCH_SPAN_US": (1_000_000, "s"),
    "MAX_AHEAD_US": (86_400_000_000, "days"),
    **dict.fromkeys(("LIVE_BROKER_EVERY_S", "UPLOAD_URL_S", "STALE_S", "GONE_S", "VIEW_RENEW_S"), (1, "s")),
    **dict.fromkeys(("LIVE_MAX_AGE_MS", "CLOCK_MAX_UNCERTAINTY_MS", "FLEET_MAX_AGE_MS"), (1, "ms")),
    **dict.fromkeys(("MAX_VALID_MS", "MAX_LEASE_MS", "MAX_ASK_MS"), (1, "ms")),
    **dict.fromkeys(("MAX_NEXT_MS", "VIEW_LEASE_MS"), (1, "ms")),
    "upload_gb_a_day": (1, "GB"),
}

# The modules that define limits.
MODULES = (limits, commands, files, questions, viewing)


def test_each_limit_has_its_value_on_the_page() -> None:
    table = {name: row for row in rows(section("### Of this project")) for name in named(row[2])}
    told = {
        **{name: getattr(of, name) for of in MODULES for name in table if hasattr(of, name)},
        "MAX_LAYOUT": MAX_LAYOUT,
        "SECOND_BATCHES": seconds.SECOND_BATCHES,
        "REFUSALS": live.REFUSALS,
        "REFUSALS_A_SECOND": live.REFUSALS_A_SECOND,
        "upload_gb_a_day": Settings.model_fields["upload_gb_a_day"].default,
    }
    assert table.keys() == told.keys()
    for name, value in told.items():
        scale, unit = UNITS.get(name, (1, ""))
        number = value / scale
        plain, grouped = f"{number:g}" if number < 10_000 else f"{number:.0f}", f"{number:,.0f}"
        assert table[name][1] in {f"{text} {unit}".strip() for text in (plain, grouped)}, name


def test_the_page_names_every_limit_of_the_contract() -> None:
    text = section("## Limits")
    every = {name for name in vars(limits) if name.isupper() and not name.startswith("_")}
    every |= {name for of in MODULES for name in vars(of) if name.startswith("MAX_")}
    # The page writes the greatest sequence number out, as 2<sup>53</sup>, wherever one stands.
    assert {name for name in every if f"`{name}`" not in text} == {"MAX_SEQ"}


def test_the_brokers_limits_equal_those_of_the_agent_and_the_embedded_cloud() -> None:
    table = {row[0]: row[1:] for row in rows(section("### Of AWS IoT, and of the embedded cloud"))}
    told = {name: row[0] for name, row in table.items()}
    assert told["a message's payload"] == f"{iot._MAX_PAYLOAD_BYTES // 1024} KiB"
    assert told["publishes a second of a connection, each way"] == str(rate_limiter.PUBLISHES_PER_S)
    assert told["bytes a second of a connection, each way"] == f"{rate_limiter.BYTES_PER_S // 1024} KiB"
    connect = table["time from the connection to CONNECT"][2]
    assert connect.startswith(f"{iot._MTLS_CONNECT_SECONDS:g} s,")
    assert f"below {rate_limiter.PUBLISHES_PER_S * rate_limiter.SHARE:g} publishes" in PAGE
