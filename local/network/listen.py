"""LISTEN= and PAGE=: an address of this machine in a network, and the names by which others reach it."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass

from local.errors import LocalError
from local.network.certificates import is_address, spelled

HTTPS_PORT = 443
_NAME = re.compile(r"(?=.{1,253}$)[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*")


def is_ipv6(host: str) -> bool:
    """Whether a host is an IPv6 address."""
    return ":" in host


@dataclass(frozen=True)
class Listen:
    """Where to listen, and every host that the certificate is for."""

    address: str
    hosts: tuple[str, ...]

    @classmethod
    def parse(cls, text: str, what: str) -> Listen:
        """Read ``address[,name or address...]``; raises `LocalError`, which names ``what``."""
        parts = spelled(part.strip() for part in text.split(",") if part.strip())
        if not parts or not is_address(parts[0]) or ipaddress.ip_address(parts[0]).is_unspecified:
            # A bundle must name it, and so must the certificate.
            got = parts[0] if parts else "nothing"
            raise LocalError(
                f"{what} must begin with an address of this machine, such as {what}=192.168.1.10 or "
                f"{what}=192.168.1.10,iort.lab, got {got}"
            )
        for name in parts:
            if "%" in name:
                # Such an address means another machine on each interface: no certificate can name it.
                raise LocalError(
                    f"{what} must have addresses that are the same for every car, got {name}: "
                    "take one that does not begin with fe80, such as fd00::10"
                )
        for name in parts[1:]:
            if not is_address(name) and not _NAME.fullmatch(name):
                raise LocalError(f"{what} must have names such as iort.lab after the address, got {name}")
        return cls(parts[0], parts)

    @property
    def host(self) -> str:
        """The host that others are told: the first name, or else the address."""
        return next((one for one in self.hosts if not is_address(one)), self.address)

    def at(self, port: int) -> str:
        """`host` and a port of an HTTPS server, as a URL and a browser's Host have them."""
        host = f"[{self.host}]" if is_ipv6(self.host) else self.host
        return host if port == HTTPS_PORT else f"{host}:{port}"

    def check(self, what: str) -> None:
        """Raise `LocalError` if this machine does not have the address (yet)."""
        family = socket.AF_INET6 if is_ipv6(self.address) else socket.AF_INET
        with socket.socket(family) as probe:
            try:
                probe.bind((self.address, 0))
            except OSError as error:
                raise LocalError(
                    f"{what} must be an address of this machine, got {self.address}: {error.strerror}; "
                    "`ip address` lists them"
                ) from error

    def __str__(self) -> str:
        return ",".join(self.hosts)
