"""What a kept cloud remembers of its starts: the file `settings.json`, which people may edit."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from typing_extensions import Self

from iort_station.output import write_private
from local.errors import LocalError

FILE = "settings.json"
# Closes again what an earlier start has opened.
NO = "no"
SERVERS = ("gateway", "mqtt", "relay", "pubnub", "files", "page", "network page")
_ANEW = "mend it, or write {} into it: then name LISTEN= and PAGE= again, and the cars' ports may be others"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The options of `make up`, and the port of each server that has listened at one."""

    listen: str = NO
    page: str = NO
    power_cut: bool = False
    any_ports: bool = False
    ports: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the folder's file. Raises `LocalError`, which names what somebody has broken."""
        path = folder / FILE
        try:
            found = json.loads(path.read_text())
        except FileNotFoundError:
            return cls()
        except ValueError as error:
            # Also bytes that are no text.
            got = repr(path.read_bytes()[:40].decode(errors="replace"))
            raise LocalError(f"{path} must be a JSON object, got {got} ({error}): {_ANEW}") from error
        if not isinstance(found, dict):
            raise LocalError(f"{path} must be a JSON object, got {found!r}: {_ANEW}")
        _check(path, "", found, _FORMS)
        _check(path, "ports.", found.get("ports", {}), dict.fromkeys(SERVERS, _PORT))
        return cls(**found)

    def save(self, folder: Path) -> None:
        """Write the folder's file, for its owner alone."""
        write_private(folder / FILE, f"{json.dumps(asdict(self), indent=2)}\n".encode())

    def with_port(self, server: str, port: int) -> Self:
        """These settings, with the port of a server."""
        return replace(self, ports={**self.ports, server: port})


_Form = tuple[str, Callable[[Any], bool]]
_HOSTS: _Form = (f"hosts such as 192.168.1.10,iort.lab, or {NO}", lambda value: isinstance(value, str))
_SWITCH: _Form = ("true or false", lambda value: isinstance(value, bool))
_PORT: _Form = ("a number from 1 to 65535", lambda value: type(value) is int and 0 < value < 65_536)
_FORMS: dict[str, _Form] = {
    "listen": _HOSTS,
    "page": _HOSTS,
    "power_cut": _SWITCH,
    "any_ports": _SWITCH,
    "ports": ("an object with a port for each server", lambda value: isinstance(value, dict)),
}


def _check(path: Path, prefix: str, found: Mapping[str, Any], forms: Mapping[str, _Form]) -> None:
    for key, value in found.items():
        if key not in forms:
            raise LocalError(
                f"{path}: a key must be one of {', '.join(prefix + one for one in forms)}, "
                f"got {prefix}{key}: rename it or remove its line"
            )
        form, good = forms[key]
        if not good(value):
            raise LocalError(f"{path}: {prefix}{key} must be {form}, got {value!r}: mend or remove it")
