"""Addresses of a network: of which kind they are, and whose."""

from __future__ import annotations

import ipaddress


def is_ipv6(host: str) -> bool:
    """Whether a host is an IPv6 address."""
    return ":" in host


def client_of(address: str) -> str:
    """Who a limit for each client counts: an IPv4 address, or the network of an IPv6 address, because whoever
    has one address of it has them all."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    return str(found) if found.version == 4 else str(ipaddress.ip_network((found, 64), strict=False))
