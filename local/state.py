"""The folder of an embedded cloud: a throw-away one begins empty, a kept one goes on."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import pwd
import re
import secrets
import shutil
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from typing_extensions import Self

from iort_station.kept import LEDGER, START_BYTES, lock_of
from iort_station.output import write_private
from iort_station.page.background import BackgroundServer
from local.processes import LocalError

# What a kept cloud remembers of its starts: the file `settings.json`, which people may edit.

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


# Of what a kept folder holds. A folder of a newer version is refused, one of an older version is converted.
VERSION = 1
# The ports that a new kept cloud takes if they are free.
USUAL_PORTS = {"mqtt": 8883, "files": 8443, "page": 8080, "network page": 8444}
# The system gives ports of this range to programs that ask for any, so a kept port is outside of it.
_EPHEMERAL = Path("/proc/sys/net/ipv4/ip_local_port_range")
_FIRST_PORT, _ATTEMPTS = 20_000, 100


class StateFolder:
    """The folder, once `take` has locked it."""

    def __init__(self, path: Path, *, kept: bool, any_ports: bool = False) -> None:
        self.path, self.kept, self._any_ports = path, kept, any_ports

    def take(self, stack: ExitStack) -> None:
        """Lock the folder until the stack closes, and clean it. Raises `LocalError` if that is not
        possible."""
        if self.kept:
            self._check_owner()
        try:
            self.path.mkdir(parents=True, exist_ok=True, mode=0o700)
            # The file stays open and locked while this cloud runs. Nobody else may lock it.
            opened = os.open(lock_of(self.path), os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o600)
            lock = stack.enter_context(os.fdopen(opened, "a+"))
        except OSError as error:
            raise LocalError(
                f"you must be able to write {self.path} and the folder that it is in: {error}"
            ) from error
        if shutil.disk_usage(self.path).free < START_BYTES:
            raise LocalError(f"{self.path} must have {START_BYTES // 2**20} MB free: free some space")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.seek(0)
            owner = lock.read().strip()
            stop = "`make down`" if self.kept else f"Ctrl-C in its terminal or `kill {owner}`"
            raise LocalError(
                f"an embedded cloud is already running in {self.path} (process {owner}): "
                f"use it, or stop it with {stop}"
            ) from error
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        if self.kept:
            self.prepare()
            # Files of an earlier run remain after a kill -9.
            shutil.rmtree(self.path / "tmp", ignore_errors=True)
        else:
            shutil.rmtree(self.path)
        (self.path / "tmp").mkdir(parents=True, mode=0o700)

    def prepare(self) -> None:
        """Make the folder of a kept cloud, for its owner alone. Raises `LocalError` if it is another folder,
        of a newer version, not its user's, or damaged."""
        self._check_owner()
        self.path.mkdir(parents=True, exist_ok=True)
        version = self.path / "VERSION"
        if not version.exists():
            if unknown := [one.name for one in self.path.iterdir()]:
                raise LocalError(
                    f"STATE must be an empty folder or one of `make up`, got {self.path} with {unknown[0]}"
                )
            self.path.chmod(0o700)
            version.write_text(f"{VERSION}\n")
        found = version.read_text(errors="replace").strip()
        if not found.isdecimal():
            raise LocalError(
                f"{version} must have the state's version, got {found!r}: write {VERSION} into it unless a "
                "newer iort has used this folder"
            )
        if int(found) > VERSION:
            raise LocalError(
                f"{self.path} must have version {VERSION} or older, got {found}: a newer iort wrote it; "
                "update this checkout, or name another folder with STATE="
            )
        self._check_whole()

    def _check_owner(self) -> None:
        """Raise `LocalError` if the folder or a file in it is not for this user."""
        with suppress(FileNotFoundError, NotADirectoryError):
            try:
                _check_own(self.path)
                for one in self.path.iterdir():
                    # A file that is made anew may go meanwhile.
                    with suppress(FileNotFoundError):
                        _check_own(one)
            except PermissionError as error:
                raise LocalError(f"you must be able to read {self.path}: {error}") from error

    def _check_whole(self) -> None:
        """Raise `LocalError` if a file is missing without which a start would begin anew."""
        ledger, settings = self.path / LEDGER, self.path / FILE
        has_ledger = ledger.exists() and ledger.stat().st_size > 0
        if self.settings().ports and not has_ledger:
            raise LocalError(
                f"{ledger} must be there with all that this cloud keeps, got "
                f"{'an empty file' if ledger.exists() else 'no such file'}: put it back, or `iort restore` a "
                "backup; another folder (STATE=) begins anew"
            )
        if has_ledger and not settings.exists():
            raise LocalError(
                f"{settings} must be there with the ports that the cars use, got no such file: put it back, "
                "or write {} into it and name LISTEN= and PAGE= again"
            )
        if not settings.exists():
            Settings().save(self.path)

    def settings(self) -> Settings:
        """What a kept cloud remembers of its last start. Raises `LocalError` if somebody has broken it."""
        return Settings.load(self.path) if self.kept else Settings()

    def remember(self, **settings: Any) -> None:
        """Change what `settings` returns."""
        if self.kept:
            replace(self.settings(), **settings).save(self.path)

    def remember_port(self, server: str, port: int) -> None:
        """Remember the port at which a server listens. One that has only been free may be another cloud's by
        now."""
        self.remember(ports={**self.settings().ports, server: port})

    def port(self, name: str, *hosts: str, wanted: int = 0) -> int:
        """The port ``wanted``, or the one of the last start, or the usual one if it is free, unless any will
        do, or a free one, on every host. Raises `LocalError` if it is in use. See `remember_port`."""
        asked = wanted or self.settings().ports.get(name, 0)
        usual = 0 if self._any_ports else USUAL_PORTS.get(name, 0)
        found = _lasting(hosts, usual) if self.kept and not asked else _free(hosts, asked)
        if found is None:
            raise self._in_use(name, asked, hosts)
        return found

    def serve(self, stack: ExitStack, name: str, server: BackgroundServer) -> None:
        """Start a server at the port that `port` has found, until the stack closes, and remember the port.
        Raises `LocalError` if somebody else has taken it since."""
        try:
            stack.enter_context(server)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise self._in_use(name, server.port, [server.host]) from error
            raise LocalError(f"cannot listen on {server.host}:{server.port}: {error}") from error
        self.remember_port(name, server.port)

    def _in_use(self, name: str, port: int, hosts: Sequence[str]) -> LocalError:
        advice = "start again, which takes another" if self.kept else "free it, give another, or none"
        if port == self.settings().ports.get(name):
            advice = (
                f"`sudo ss -tanp 'sport = :{port}'` names the program. End it (another cloud of this "
                "machine by `make down STATE=its folder`), or choose another port for this one in "
                f"{self.path / FILE}"
            )
            if name == "mqtt":
                # It is in the bundles.
                advice += ", and write it into the car.yaml of its cars"
        return LocalError(f"port {port} ({name}) is in use on {' or '.join(hosts)}: {advice}")

    def secret(self, name: str, size: int = 20) -> str:
        """A random text, the same one at each start of a kept cloud as long as its file is whole."""
        path = self.path / name
        # Only `cloud.json` tells it, which is made anew at each start.
        if not path.exists() or not re.fullmatch(rb"[0-9a-f]{%d}" % (2 * size), path.read_bytes()):
            write_private(path, secrets.token_hex(size).encode())
        return path.read_text()


def _check_own(path: Path) -> None:
    """Raise `LocalError` if a path is another user's, or if this user cannot use it."""
    found, own = path.stat(), os.geteuid()
    if found.st_uid != own:
        raise LocalError(
            f"{path} must belong to {_name(own)}, got {_name(found.st_uid)}: only its owner runs this cloud, "
            f"or `sudo chown -R {_name(own)} {path}` gives it to you"
        )
    if not os.access(path, os.R_OK | os.W_OK | (os.X_OK if path.is_dir() else 0)):
        raise LocalError(
            f"you must be able to read and write {path}, got mode {found.st_mode & 0o777:o}: "
            f"`chmod -R u+rwX {path}`"
        )


def _name(uid: int) -> str:
    """A user's name, or the number of one without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _lasting(hosts: Sequence[str], usual: int) -> int | None:
    """The port ``usual`` if it is free, or one that no program has by chance at the next boot."""
    if usual and _free(hosts, usual):
        return usual
    try:
        low, high = map(int, _EPHEMERAL.read_text().split())
    except (OSError, ValueError):
        # Not Linux: the range of RFC 6335.
        low, high = 49_152, 65_535
    ports = [*range(_FIRST_PORT, low), *range(max(_FIRST_PORT, high + 1), 65_536)]
    for _ in range(_ATTEMPTS if ports else 0):
        if found := _free(hosts, secrets.choice(ports)):
            return found
    return _free(hosts, 0)


def _free(hosts: Sequence[str], port: int) -> int | None:
    """The port, or a free one for 0; None if it is in use on a host."""
    for host in hosts:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return None
                raise LocalError(f"cannot listen on {host}:{port}: {error}") from error
            port = int(probe.getsockname()[1])
    return port
