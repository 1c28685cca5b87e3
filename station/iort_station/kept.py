"""The kept cloud of `make up`, as other programs on this machine find it: its folder, and `up.json` in it."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from iort_station.errors import StationError

UP = "up.json"
CLOUD = "cloud.json"
LEDGER = "ledger.db"
# Free space of the disk: a start needs the first, and below the second the record lane is refused.
START_BYTES, FLOOR_BYTES = 500 * 1024 * 1024, 200 * 1024 * 1024


def folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where `make up` keeps its cloud, unless told otherwise by ``STATE=``."""
    return _data(environment) / "cloud"


def pages(environment: Mapping[str, str] = os.environ) -> Path:
    """Where the pages that this user serves give invitations: see `iort_station.page.invitations`."""
    return _data(environment) / "pages"


def bridge(environment: Mapping[str, str] = os.environ) -> Path:
    """Where `iort bridge` keeps its password for a cloud that has no page of its own."""
    return _data(environment) / "bridge"


def _data(environment: Mapping[str, str]) -> Path:
    home = (
        environment.get("XDG_DATA_HOME") or Path(environment.get("HOME", "~")).expanduser() / ".local/share"
    )
    return Path(home) / "iort"


def running(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """The files of the embedded clouds that this user runs, wherever their folders are."""
    links = _links(environment)
    files = [link.readlink() for link in links.iterdir()] if links.is_dir() else []
    # One that was killed has left its link and its file.
    return sorted(file for file in files if file.exists() and owner(file.parent) is not None)


@contextmanager
def announced(file: Path) -> Iterator[None]:
    """Have `running` list an embedded cloud during the block."""
    link = _links(os.environ) / hashlib.sha256(bytes(file.absolute())).hexdigest()[:16]
    # Without a home to write to, its commands name it by --embedded.
    with suppress(OSError):
        link.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        link.unlink(missing_ok=True)
        link.symlink_to(file.absolute())
    try:
        yield
    finally:
        with suppress(OSError):
            link.unlink(missing_ok=True)


def _links(environment: Mapping[str, str]) -> Path:
    return folder(environment).with_name("running")


def lock_of(folder: Path) -> Path:
    """The file that an embedded cloud locks while it runs; it has its process id."""
    # A link to the folder means the same cloud.
    real = folder.resolve()
    return real.parent / f"{real.name}.lock"


def owner(folder: Path) -> int | None:
    """The process that holds a folder's lock, if there is one."""
    try:
        with lock_of(folder).open() as lock:
            pid = int(lock.read())
            opened = _has_open(pid, lock.fileno())
            # To try the lock would hinder a start at the same moment, so it is done only where nothing else
            # tells.
            return pid if opened or (opened is None and _is_locked(lock.fileno())) else None
    except (FileNotFoundError, ValueError):
        return None


def _has_open(pid: int, file: int) -> bool | None:
    """Whether a process has this file open, as an owner has; None where nothing tells. The number in the file
    may be that of an earlier owner."""
    ours = os.fstat(file)
    if pid == os.getpid() or not Path("/proc/self/fd").is_dir():
        return None
    try:
        opened = list(Path(f"/proc/{pid}/fd").iterdir())
    except FileNotFoundError:
        return False
    except PermissionError:
        # Another user's.
        return None
    for one in opened:
        with suppress(FileNotFoundError):
            if os.path.samestat(one.stat(), ours):
                return True
    return False


def _is_locked(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    return False


def page_certificate(folder: Path) -> Path | None:
    """The file with key and certificate of the page that a running kept cloud serves to a network, if it
    does; raises `StationError` if none is up."""
    found = (Path(one.file) for one in Up.load(folder).certificates if one.name == "page")
    return next(found, None)


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """A server's certificate: its name, its file, the hosts that it is for, and its end since the epoch."""

    name: str
    file: str
    hosts: list[str]
    ends_s: float


@dataclass(frozen=True, kw_only=True)
class Up:
    """A running kept cloud. It is written again whenever something in it changes, and removed at the end;
    after a kill its processes are gone.

    ``version`` is that of the state folder, ``versions`` those of the programs. ``pids`` has ``up``, the
    process that started the others, and ``emulator``. ``ports`` are by name: ``gateway``, ``relay``,
    ``page`` and ``mqtt`` on loopback; ``mqtt`` and ``files`` on the first host of ``listen``, if there is
    one, and ``network page`` on that of ``page``. ``ledger`` is the path of its SQLite file. With
    ``power_cut`` it survives that, too.
    """

    version: int
    versions: dict[str, str]
    started_s: float
    pids: dict[str, int]
    ports: dict[str, int]
    listen: list[str]
    page: list[str]
    certificates: list[Certificate]
    ledger: str
    power_cut: bool

    @classmethod
    def load(cls, folder: Path) -> Up:
        """The kept cloud of a folder; raises `StationError` if none is up, or has been."""
        path = folder / UP
        try:
            told = json.loads(path.read_text())
            certificates = [Certificate(**one) for one in told.pop("certificates")]
            return cls(**told, certificates=certificates)
        except FileNotFoundError as error:
            raise StationError(f"no cloud is up in {folder}: `make up` starts one") from error
        except (OSError, TypeError, ValueError, KeyError) as error:
            raise StationError(f"{path} must describe a kept cloud: {error}") from error

    def text(self) -> str:
        """The content of its file."""
        return json.dumps(asdict(self), indent=2) + "\n"
