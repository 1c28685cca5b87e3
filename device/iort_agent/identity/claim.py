"""A provisioning claim: a certificate that can only be exchanged for the robot's own, and its claim.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from iort_agent.common.schema import Place, any_path, existing_path, load, number, read_yaml, setting, text
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.topics import check_namespace, check_robot


@dataclass(frozen=True)
class Claim:
    """The content of claim.yaml. ``config`` is the configuration file to write or to update."""

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
    """Read a claim file. Raises `ConfigError`."""
    return load(Claim, read_yaml(file), Place(file))
