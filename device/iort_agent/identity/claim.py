"""A claim: the certificate that is good for getting the robot's own, and what claim.yaml says beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from iort_agent.schema import Where, any_path, existing_path, load, number, read_yaml, setting, text
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.topics import check_namespace, check_robot


@dataclass(frozen=True)
class Claim:
    """What claim.yaml says. ``config`` is the file to write, or to update where it exists."""

    endpoint: str = setting(text())
    certificate: Path = setting(existing_path())
    private_key: Path = setting(existing_path())
    root_ca: Path | None = setting(existing_path(), None)
    namespace: str = setting(text(check_namespace), DEFAULT_NAMESPACE)
    port: int = setting(number(1, 65535, whole=True), 8883)
    robot: str | None = setting(text(check_robot), None)
    serial: str | None = setting(text(), None)
    config: Path | None = setting(any_path(), None)


def load_claim(file: Path) -> Claim:
    """The claim in a file. Raises `ConfigError`."""
    return load(Claim, read_yaml(file), Where(file))
