"""What the doctor finds on the machine that keeps a cloud, before it looks into the deployment."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import socket
import ssl
import time
from collections.abc import Generator, Iterator
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from botocore.exceptions import BotoCoreError, ClientError
from cryptography import x509

from iort_station import kept
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.kept import Up
from iort_station.upkeep import deployment
from iort_station.upkeep.deployment import FAIL, OK, WARN, Finding, graded
from iort_station.upkeep.snapshot import LAST_BACKUP

# Facts of the machine that keeps a cloud: memory, processes, whether a time server sets its clock.

_PROC = Path("/proc")
# adjtimex(2): the clock's state without a server of time, and room for its struct.
_TIME_ERROR, _TIMEX_BYTES = 5, 512


class Memory(NamedTuple):
    """The machine's memory in bytes."""

    total: int
    available: int


def memory() -> Memory | None:
    """The machine's memory; None where it cannot be told, which is on systems other than Linux."""
    found = dict(_lines(_PROC / "meminfo"))
    return Memory(found["MemTotal"], found["MemAvailable"]) if "MemAvailable" in found else None


def runs(pid: int) -> bool:
    """Whether there is such a process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def family(pid: int) -> list[int]:
    """A process and those that it started, as far as they run; empty where that cannot be told."""
    children: dict[int, list[int]] = {}
    for status in _PROC.glob("[0-9]*/status"):
        with suppress(OSError):
            parent = next(line for line in status.read_text().splitlines() if line.startswith("PPid:"))
            children.setdefault(int(parent.split()[1]), []).append(int(status.parent.name))
    found = [pid] if (_PROC / str(pid)).exists() else []
    for one in found:
        found += children.get(one, [])
    return found


def resident_bytes(pid: int) -> int:
    """The memory of a process; 0 if it has ended."""
    return dict(_lines(_PROC / str(pid) / "status")).get("VmRSS", 0)


def processor_s(pid: int) -> float:
    """The processor time of a process so far; 0 if it has ended."""
    with suppress(OSError):
        # Behind the name, which may have spaces: "proc_pid_stat(5)".
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def clock_is_set() -> bool | None:
    """Whether the kernel knows that a server of time sets the clock; None where it cannot be told."""
    try:
        return bool(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)) != _TIME_ERROR)
    except (AttributeError, OSError):
        return None


def _lines(path: Path) -> Iterator[tuple[str, int]]:
    """The sizes of one of the kernel's files, in bytes."""
    with suppress(OSError):
        for line in path.read_text().splitlines():
            name, _, value = line.partition(":")
            if value.endswith(" kB"):
                yield name, int(value.split()[0]) * 1024


_CONNECT_S = 3.0
_LOW_BYTES = 5_000_000_000
# Shares of the machine's memory.
_LEAST_AVAILABLE, _MOST_OURS = 0.1, 0.5
# The share of a core, or of all cores, at which summaries begin to fall behind ("How much one machine takes"
# in docs/explanation/processing.md), and the share of this at which it is time to know.
_FULL_BUSY, _MOST_LOAD, _MEASURED_S = 0.8, 0.8, 2.0
# A server's certificate gets a successor 30 days before its end.
_NOT_RENEWED_S, _BACKUP_S = 25 * 86_400, 7 * 86_400


def of_kept(folder: Path) -> Iterator[Finding]:
    """Look at the cloud of `make up` and at its machine."""
    try:
        up = Up.load(folder)
    except StationError as error:
        yield Finding("processes", FAIL, str(error), "`make up`")
        if folder.is_dir():
            yield _disk(folder)
        yield _backup(folder)
        return
    running = kept.owner(folder) is not None and all(map(runs, up.pids.values()))
    busy = None
    yield _processes(folder, up, running=running)
    if running:
        yield _version(up)
        yield from _addresses(up)
        busy = yield from _emulator(up.pids["emulator"])
    safe = "survives a power cut" if up.power_cut else "survives a kill, not a power cut (POWER_CUT=1)"
    yield _disk(folder, f" and {safe}")
    yield from _certificates(up)
    yield _clock()
    yield _backup(folder)
    if not running:
        return
    full = shutil.disk_usage(folder).free < kept.FLOOR_BYTES
    yield from map(_on_a_full_disk, _deployment(folder, busy)) if full else _deployment(folder, busy)


def _deployment(folder: Path, busy: float | None) -> Iterator[Finding]:
    try:
        yield from deployment.findings(Cloud.load(folder / kept.CLOUD), busy)
    except (StationError, ClientError, BotoCoreError) as error:
        yield Finding("deployment", FAIL, f"does not answer: {error}", "`make down`, then `make up`")


def _on_a_full_disk(found: Finding) -> Finding:
    """Records are refused then, and any call while another one cannot be written: other advice misleads."""
    return found._replace(todo="free some of the disk, and look again") if found.todo else found


def of_cloud(cloud: Cloud) -> Iterator[Finding]:
    """Look at a deployment on AWS, or at an embedded cloud that is thrown away."""
    if cloud.endpoint_url is None:
        text = f"AWS runs this deployment, in {cloud.region_name}: processes, disk and servers are its own"
        yield Finding("machine", OK, text)
        yield deployment.clock(cloud)
    else:
        text = "this cloud is thrown away when it ends: its processes, disk and backups are not looked at"
        yield Finding("machine", WARN, text, "`make up` runs one that is kept")
    yield from deployment.findings(cloud)


def _processes(folder: Path, up: Up, *, running: bool) -> Finding:
    if not running:
        # A cloud that is stopped removes this file.
        killed = (folder / kept.CLOUD).exists()
        text = "were killed, or the machine was switched off" if killed else "were stopped: no cloud is up"
        todo = f"`make up` starts it again; what it acknowledged is in {folder}"
        return Finding("processes", FAIL, text, todo)
    names = ", ".join(f"{name} {pid}" for name, pid in up.pids.items())
    return Finding("processes", OK, f"{names}, for {_span(time.time() - up.started_s)}")


def _version(up: Up) -> Finding:
    installed, running = version("iort-station"), up.versions.get("iort")
    return graded(
        "version",
        f"{running} runs" + ("" if running == installed else f", and {installed} is installed"),
        "`make down`, then `make up`, to run the installed one",
        warn=running != installed,
    )


def _addresses(up: Up) -> Iterator[Finding]:
    """Whether every server answers, and which certificate the broker shows."""
    cars, pages = (hosts[0] if hosts else "127.0.0.1" for hosts in (up.listen, up.page))
    hosts = {"gateway": "127.0.0.1", "relay": "127.0.0.1", "mqtt": cars, "page": "127.0.0.1"}
    hosts |= ({"files": cars} if up.listen else {}) | ({"network page": pages} if up.page else {})
    silent = []
    for name, host in hosts.items():
        if name in up.ports:
            try:
                socket.create_connection((host, up.ports[name]), _CONNECT_S).close()
            except OSError as error:
                silent.append(f"{name} at {_at(host, up.ports[name])} ({error.strerror or error})")
    if silent:
        todo = "`make down`, then `make up`; does this machine still have the address of LISTEN or PAGE?"
        yield Finding("servers", FAIL, f"no answer from {', '.join(silent)}", todo)
        return
    where = f"cars connect to {_at(cars, up.ports['mqtt'])}" if up.listen else "cars of this machine only"
    yield Finding("servers", OK, f"all answer; {where}")
    shown_s = _shown_end_s(cars, up.ports["mqtt"])
    written_s = next((one.ends_s for one in up.certificates if one.name == "broker"), None)
    if shown_s is None:
        text = "it shows no certificate, so no car can connect"
        yield Finding("broker", FAIL, text, "`make down`, then `make up`")
    elif written_s is not None and abs(shown_s - written_s) > 1:
        text = f"the broker shows a certificate that ends on {_day(shown_s)}, not the one in its file"
        yield Finding("broker", WARN, text, "`make down`, then `make up`, before that day")


def _at(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _shown_end_s(host: str, port: int) -> float | None:
    """The end of the certificate that a server shows; None if it shows none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with suppress(OSError, ValueError):
        raw = socket.create_connection((host, port), _CONNECT_S)
        with closing(raw), closing(context.wrap_socket(raw)) as secure:
            der = secure.getpeercert(binary_form=True) or b""
        return x509.load_der_x509_certificate(der).not_valid_after_utc.timestamp()
    return None


def _disk(folder: Path, safe: str = "") -> Finding:
    free = shutil.disk_usage(folder).free
    ledger = folder / kept.LEDGER
    wal = ledger.with_name(f"{ledger.name}-wal")
    parts = [one.stat().st_size for one in (ledger, wal) if one.exists()]
    return graded(
        "disk",
        f"{free / 1e9:,.1f} GB free for {folder}; the ledger has {sum(parts) / 1e6:,.1f} MB{safe}",
        "free some of it, or move the state: `make down`, `iort backup`, `iort restore`. Below "
        f"{kept.FLOOR_BYTES / 1e9:.1f} GB recordings are refused, and the cars keep them; a start needs "
        f"{kept.START_BYTES / 1e9:.1f} GB",
        warn=free < _LOW_BYTES,
        fail=free < kept.START_BYTES,
    )


def _emulator(pid: int) -> Generator[Finding, None, float | None]:
    """Memory and load; returns the share of what the machine takes that it has to do."""
    processes, whole, cores = family(pid), memory(), os.cpu_count() or 1
    if not processes or whole is None:
        yield Finding("memory", OK, "this system does not tell it")
        return None
    ours = sum(map(resident_bytes, processes))
    yield graded(
        "memory",
        f"the emulator has {ours / 1e6:,.0f} MB; {whole.available / 1e9:,.1f} of {whole.total / 1e9:,.1f} GB "
        "are available",
        "`make down`, then `make up`, gives it back and loses nothing; look at this machine's other programs",
        warn=ours > _MOST_OURS * whole.total or whole.available < _LEAST_AVAILABLE * whole.total,
    )
    began, before = time.monotonic(), {one: processor_s(one) for one in processes}
    time.sleep(_MEASURED_S)
    passed_s = time.monotonic() - began
    busy = {one: max(0.0, processor_s(one) - was) / passed_s for one, was in before.items()}
    # The emulator computes on one core; its functions are processes of their own.
    taken = max(busy[pid], sum(busy.values()) / cores) / _FULL_BUSY
    yield graded(
        "load",
        f"the emulator is busy {busy[pid]:.0%} of the time, and its functions "
        f"{(sum(busy.values()) - busy[pid]) / cores:.0%} of {cores} cores: {taken:.0%} of what this machine "
        "takes",
        "fewer cars, slower streams or a faster machine: at 100 % summaries fall behind, and nothing is lost",
        warn=taken > _MOST_LOAD,
    )
    return taken


def _certificates(up: Up) -> Iterator[Finding]:
    for one in up.certificates:
        left_s = one.ends_s - time.time()
        yield graded(
            f"certificate of {one.name}",
            f"for {', '.join(one.hosts)}, until {_day(one.ends_s)}",
            "it should have been renewed 30 days before: `make down`, then `make up`, renews it",
            warn=left_s < _NOT_RENEWED_S,
            fail=left_s < 0,
        )


def _clock() -> Finding:
    is_set = clock_is_set()
    if is_set is None:
        return Finding("clock", OK, "this system does not tell whether a server of time sets it")
    return graded(
        "clock",
        "a server of time sets it" if is_set else "no server of time sets it, so it drifts",
        "`timedatectl set-ntp true`. Cars compare their clocks with this one",
        warn=not is_set,
    )


def _backup(folder: Path) -> Finding:
    todo = "`iort backup FILE`, to another disk"
    try:
        told = json.loads((folder / LAST_BACKUP).read_text())
        age_s, file = time.time() - told["made_s"], told["file"]
    except FileNotFoundError:
        return Finding("backup", WARN, "there was none yet", todo)
    except (OSError, TypeError, ValueError, KeyError) as error:
        return Finding("backup", WARN, f"{folder / LAST_BACKUP} is damaged: {error}", todo)
    return graded("backup", f"{_span(age_s)} ago, to {file}", todo, warn=age_s > _BACKUP_S)


def _day(at_s: float) -> str:
    return time.strftime("%Y-%m-%d", time.gmtime(at_s))


def _span(seconds: float) -> str:
    """A time in its largest whole unit."""
    for name, size in (("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{max(0.0, seconds):.0f} seconds"
