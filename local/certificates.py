"""Certificates for servers on this machine: queues refuse plain HTTP, and robots refuse plain MQTT."""

from __future__ import annotations

import os
from pathlib import Path

import trustme


class Authority:
    """Signs certificates that nobody trusts unless told to."""

    def __init__(self) -> None:
        self._authority = trustme.CA(organization_name="iort", organization_unit_name="this machine")

    def write(self, folder: Path, name: str, host: str) -> tuple[Path, Path]:
        """Write ``<name>.pem`` and ``<name>.key`` for an IP address and return their paths.

        The authority's certificate is behind the other one, so that clients may trust the same file. Only the
        owner may read the key.
        """
        leaf = self._authority.issue_cert(host, common_name=name)
        certificate_path, key_path = folder / f"{name}.pem", folder / f"{name}.key"
        leaf.cert_chain_pems[0].write_to_path(certificate_path)
        self._authority.cert_pem.write_to_path(certificate_path, append=True)
        with os.fdopen(os.open(key_path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
            file.write(leaf.private_key_pem.bytes())
        return certificate_path, key_path

    def write_own(self, path: Path) -> None:
        """Write the authority's own certificate."""
        self._authority.cert_pem.write_to_path(path)
