"""A robot's bundle: car.yaml, certificate and key, readable only by their owner."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.control.driving import DOWNLINK_NOTE, stick_downlink
from iort_station.cloud import Cloud


@dataclass(frozen=True)
class Bundle:
    """The folder of car.yaml and the files that it names."""

    robot: str
    folder: Path

    @property
    def config(self) -> Path:
        return self.folder / "car.yaml"


def write_bundle(
    cloud: Cloud, bundle: Bundle, certificate_pem: str, private_key_pem: str, settings: Mapping[str, Any]
) -> None:
    """Write the bundle's files."""
    written = connection(cloud, bundle.folder, certificate_pem, private_key_pem)
    config: dict[str, Any] = {"robot": bundle.robot, **written}
    config["sources"] = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}]
    config["queue"] = {"path": "queue.db"}
    config.update(settings)
    text = yaml.safe_dump(config, sort_keys=False)
    # Other sources may have no ROS graph to take commands.
    if not {"sources", "downlink"} & settings.keys():
        text += DOWNLINK_NOTE + yaml.safe_dump({"downlink": stick_downlink()}, sort_keys=False)
    write_private(bundle.config, text)


def connection(
    cloud: Cloud, folder: Path, certificate_pem: str, private_key_pem: str, *, prefix: str = ""
) -> dict[str, Any]:
    """Write the connection's files into the folder; returns the settings that name them."""
    files = {"certificate": f"{prefix}certificate.pem", "private_key": f"{prefix}private.key"}
    write_private(folder / files["certificate"], certificate_pem)
    write_private(folder / files["private_key"], private_key_pem)
    if cloud.root_ca_pem is not None:
        files["root_ca"] = "root-ca.pem"
        write_private(folder / files["root_ca"], cloud.root_ca_pem)
    return {
        "namespace": cloud.namespace,
        "endpoint": cloud.mqtt_endpoint,
        "port": cloud.mqtt_port,
        **files,
    }


def configure(bundle: Bundle, settings: Mapping[str, Any]) -> None:
    """Change settings in a bundle's car.yaml."""
    config = yaml.safe_load(bundle.config.read_text())
    write_private(bundle.config, yaml.safe_dump({**config, **settings}, sort_keys=False))


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner can read."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write(text)
