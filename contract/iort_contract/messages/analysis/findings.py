"""A finding: what the analysis says of a drive, with its evidence. And the rows of the table of findings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Mapping, NamedTuple

from iort_contract.checks import shown, text
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import number, read

# The share of repetitions in which an estimate's interval holds the truth.
INTERVAL = 0.9
# The run of a finding that is about no drive: a robot's drives could not be found.
NO_RUN = "00000000"


class Estimate(NamedTuple):
    """A value with its `INTERVAL`, in a unit."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class DriveKey:
    """A drive: what a robot recorded from one stand to the next, in one run of its agent."""

    robot: str
    start_us: int
    run: str

    def __str__(self) -> str:
        """A text that sorts by time."""
        return f"{self.start_us:016d}-{self.run}"


@dataclass(frozen=True)
class Finding:
    """One finding about a drive.

    ``kind`` is an entry of the catalogue. ``subject`` is the parameter that changed, or the kind of an event.
    ``from_us`` to ``to_us`` is the evidence in the fields of a stream. ``effect`` is the size of the change
    or event, ``baseline`` what it is compared with. ``p`` is the chance of such an effect in a healthy car,
    and ``q`` the false discovery rate at which it still counts.
    """

    drive: DriveKey
    kind: str
    severity: str
    subject: str
    from_us: int
    to_us: int
    stream: str
    fields: tuple[str, ...]
    text: str
    effect: Estimate | None = None
    baseline: Estimate | None = None
    p: float | None = None
    q: float | None = None

    @property
    def id(self) -> str:
        """Unique within the robot, and the same whenever the drive is analysed again."""
        return f"{self.drive}-{self.kind}-{self.subject}-{self.from_us:016d}"


def encode_finding(finding: Finding) -> dict[str, Any]:
    """The finding as an object for JSON."""
    content = {name: value for name, value in vars(finding).items() if value is not None and name != "drive"}
    for name in ("effect", "baseline"):
        if name in content:
            content[name] = encode_estimate(content[name])
    return {**content, "fields": list(finding.fields), **vars(finding.drive)}


def decode_finding(content: Mapping[str, Any]) -> Finding:
    """Decode a finding; raises `ContractError`."""
    return read(
        Finding,
        {**content, "drive": content},
        drive=partial(read, DriveKey),
        effect=decode_estimate,
        baseline=decode_estimate,
    )


def encode_estimate(estimate: Estimate) -> dict[str, Any]:
    """The estimate as an object for JSON."""
    return estimate._asdict()


def decode_estimate(content: Any) -> Estimate:
    """Decode an estimate; raises `ContractError`."""
    if not isinstance(content, Mapping):
        raise ContractError(f"estimate must be an object, got {shown(content)}")
    value, low, high = (number(content, name) for name in ("value", "low", "high"))
    return Estimate(value, low, high, text(content, "unit"))
