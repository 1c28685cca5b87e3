"""`make up`: the project's stacks in an embedded cloud that is kept, until Ctrl-C or `make down`.

python -m local.up.run --state ~/.local/share/iort/cloud --listen 192.168.1.10,iort.lab"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import socket
import ssl
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import version
from types import TracebackType
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError
from typing_extensions import Self

from iort_contract.cloud import IOT
from iort_station import kept
from iort_station.cloud import EMBEDDED_VARIABLE, Cloud
from iort_station.errors import StationError
from iort_station.output import write_private
from iort_station.page import answers as control
from iort_station.page.answers import actions, answers, downloads
from iort_station.page.motion import reaching
from iort_station.page.password import Password, first_password
from iort_station.page.server import PageServer
from local.cloud import EmbeddedCloud
from local.network.servers import Listen, is_ipv6
from local.processes import EmulatorError, LocalError, interrupt_by_signals
from local.state import FILE, NO, VERSION, Settings, StateFolder
from local.up import commands
from local.up.network_page import SOCKET, NetworkPage

# systemd's notifications: whoever waits for the service knows when it is ready (sd_notify(3)).


def tell(state: str) -> None:
    """Tell systemd a state, such as READY=1; without systemd nothing happens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        # An @ stands for the abstract namespace.
        systemd.connect(address.replace("@", "\0", 1) if address.startswith("@") else address)
        systemd.sendall(state.encode())


# The pages of a kept cloud: one for this machine, and with ``PAGE=`` one for a network.


class Pages:
    """Serves within a ``with`` block. ``new_password`` is set if the network's page has got its first one."""

    def __init__(self, embedded: EmbeddedCloud, listen: Listen | None) -> None:
        self._embedded, self._listen = embedded, listen
        self._exit = ExitStack()
        self.new_password: str | None = None
        self.here: PageServer
        self.network: NetworkPage | None = None

    def __enter__(self) -> Self:
        embedded, listen = self._embedded, self._listen
        with ExitStack() as stack:
            port = embedded.state.port("page", embedded.host)
            self.here = PageServer(port=port, invitations=kept.pages(), **shown(embedded.cloud))
            embedded.state.serve(stack, "page", self.here)
            if listen is not None:
                port = embedded.state.port("network page", listen.address)
                password = Password(embedded.folder)
                self.new_password = password.make()
                # The broker is at the page's own address, behind the same login.
                socket = f"wss://{listen.at(port)}{SOCKET}"
                self.network = NetworkPage(
                    listen,
                    port,
                    password=password,
                    gateway=embedded.cloud.endpoint_url or "",
                    trusts=ssl.create_default_context(cafile=embedded.cloud.ca_bundle),
                    context=embedded.certificate("page", listen.hosts).context(),
                    **shown(replace(embedded.cloud, websocket=socket)),
                )
                embedded.state.serve(stack, "network page", self.network)
            self._exit = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exit.close()


def shown(cloud: Cloud) -> dict[str, Any]:
    """What a page shows and does, as `iort dashboard` on this machine."""
    return {
        "namespace": cloud.namespace,
        **reaching(cloud, IOT),
        "answers": answers(cloud),
        "downloads": downloads(cloud),
        "open_actions": actions(cloud),
        "actions": control.keyed_actions(cloud),
    }


_LISTEN, _PAGE = "LISTEN", "PAGE"
_HOSTS = ("listen", "page")
_LOOK_S = 1.0
_RENEW_S = 3600.0
# An emulator that ends by itself is started again, unless that happens so often in this time.
_MOST_ENDS, _ENDS_S = 3, 600.0
_MOST_LOG_BYTES = 20 * 1024 * 1024


def main() -> None:
    """Run until SIGINT, SIGTERM or SIGHUP. The exit status is 0 then, and 1 if the cloud cannot run."""
    parser = commands.parser("up", "Run the stacks in a cloud of your own, which is kept.", remembered=True)
    given, stopped = parser.parse_args(), threading.Event()

    interrupt_by_signals(stopped)
    # For sockets: whoever opens many must not take those of the robots. The emulator inherits it.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    try:
        _Kept(given, stopped).run()
    except (LocalError, StationError) as error:
        sys.exit(f"up: {error}")
    except (BotoCoreError, ClientError) as error:
        sys.exit(f"up: the embedded cloud refused a call: {error}")
    except OSError as error:
        sys.exit(f"up: {error}; {given.state} must be yours, whole, and on a disk with room")
    except KeyboardInterrupt:
        _say("stopped; everything is kept")


class _Kept:
    def __init__(self, given: argparse.Namespace, stopped: threading.Event) -> None:
        self._given, self._stopped = given, stopped
        self._state = StateFolder(given.state, kept=True)
        # Of this start, and of the first one.
        self._began, self._started_s = time.monotonic(), time.time()
        self._ports: Mapping[str, int] = {}

    def run(self) -> None:
        """Run the cloud, and start it again when its emulator has ended."""
        ends: list[float] = []
        while not self._stopped.is_set():
            try:
                self._once()
            except EmulatorError as ended:  # noqa: PERF203 - once a start
                ends = [at for at in ends if time.monotonic() - at < _ENDS_S] + [time.monotonic()]
                if len(ends) >= _MOST_ENDS:
                    raise LocalError(
                        f"{ended}\nIt ended {len(ends)} times within {_ENDS_S / 60:.0f} min"
                    ) from ended
                _say(f"{ended}\nIt is started again")

    def _once(self) -> None:
        self._began = time.monotonic()
        settings = self._settings()
        listen, page = self._listen(settings.listen, _LISTEN), self._listen(settings.page, _PAGE)
        embedded = EmbeddedCloud(
            self._state.path,
            live=IOT,
            progress=self._step,
            kept=True,
            any_ports=settings.any_ports,
            power_cut=settings.power_cut,
            listen=listen,
            # systemd tells a service so that its output is the journal's.
            journal="JOURNAL_STREAM" in os.environ,
        )
        with embedded, Pages(embedded, page) as pages, ExitStack() as stack:
            self._state.remember(
                listen=settings.listen,
                page=settings.page,
                power_cut=settings.power_cut,
                any_ports=settings.any_ports,
            )
            self._ports = self._state.settings().ports
            stack.callback((embedded.folder / kept.UP).unlink, missing_ok=True)
            self._write(embedded, page)
            embedded.show_page(pages.here.url)
            _say(f"\n{self._told(embedded, pages)}\n")
            tell("READY=1")
            self._watch(embedded, page)

    def _watch(self, embedded: EmbeddedCloud, page: Listen | None) -> None:
        renewed = time.monotonic()
        while not self._stopped.is_set():
            if embedded.emulator.wait(_LOOK_S) is not None:
                raise EmulatorError(embedded.emulator.ended())
            embedded.emulator.shorten_log(_MOST_LOG_BYTES)
            if time.monotonic() - renewed > _RENEW_S:
                renewed = time.monotonic()
                self._renew(embedded, page)

    def _renew(self, embedded: EmbeddedCloud, page: Listen | None) -> None:
        try:
            if embedded.renew():
                self._write(embedded, page)
        except OSError as error:
            # A month is left to try again; on a full disk the cloud must go on and refuse records.
            _say(f"the certificates are renewed later: {error}")

    def _settings(self) -> Settings:
        """The options, and what an earlier start remembers where they say nothing."""
        given, known = self._given, self._state.settings()
        hosts = {name: getattr(given, name) for name in _HOSTS}
        told: dict[str, Any] = {name: text for name, text in hosts.items() if text is not None}
        if given.power_cut is not None:
            told["power_cut"] = given.power_cut == "1"
        if given.ports == "any":
            told["any_ports"] = True
        return replace(known, **told)

    def _listen(self, text: str, what: str) -> Listen | None:
        try:
            return _listen(text, what)
        except LocalError as error:
            if getattr(self._given, what.lower()) is not None:
                raise
            raise LocalError(
                f"{error}. {self._state.path / FILE} remembers it: give another {what}=, or {what}={NO}"
            ) from error

    def _write(self, embedded: EmbeddedCloud, page: Listen | None) -> None:
        up = kept.Up(
            version=VERSION,
            versions={
                "iort": version("iort-station"),
                "ministack": version("ministack"),
                "python": platform.python_version(),
            },
            started_s=self._started_s,
            pids={"up": os.getpid(), "emulator": embedded.emulator.pid},
            ports=dict(self._ports),
            listen=list(embedded.listen.hosts) if embedded.listen else [],
            page=list(page.hosts) if page else [],
            certificates=[
                kept.Certificate(
                    name=one.name, file=str(one.path), hosts=list(one.hosts), ends_s=one.ends_s()
                )
                for one in embedded.certificates
            ],
            ledger=str(embedded.ledger),
            power_cut=embedded.power_cut,
        )
        write_private(embedded.folder / kept.UP, up.text().encode())

    def _step(self, name: str) -> None:
        _say(f"{time.monotonic() - self._began:5.1f} s  {name}")

    def _told(self, embedded: EmbeddedCloud, pages: Pages) -> str:
        state = "" if embedded.folder == kept.folder() else f" STATE={embedded.folder}"
        robots = ".venv/bin/iort robots add car1"
        if state:
            robots = f"{EMBEDDED_VARIABLE}={embedded.folder / kept.CLOUD} {robots}"
        # An invitation lets whoever is first drive: it is for a terminal, which nobody else reads.
        here = pages.here.invitation() if sys.stdout.isatty() else pages.here.url
        told = [("kept in", str(embedded.folder)), ("page here", here)]
        if pages.network is not None:
            how = f"the password of `make up-password{state}`"
            if pages.new_password:
                how = first_password(pages.new_password, f"make up-password{state}", sys.stdout)
            told.append(("page, network", f"{pages.network.url}, {how}"))
        if embedded.listen:
            where = embedded.listen.at(embedded.ports["mqtt"])
            told.append(
                ("cars", f"connect to {where} on {embedded.listen.address}; files go to {embedded.files_url}")
            )
        else:
            told.append(("cars", "of this machine only; LISTEN=address opens it to the network"))
        told += [
            ("a new car", robots),
            ("to stop", f"Ctrl-C, or `make down{state}`; `make up{state}` goes on"),
        ]
        return "\n".join(f"{name:>14}  {text}" for name, text in told)


def _listen(text: str, what: str) -> Listen | None:
    if text == NO:
        return None
    listen = Listen.parse(text, what)
    if what == _PAGE and is_ipv6(listen.host):
        # A Content-Security-Policy cannot name such an address, so the browser would refuse the broker.
        raise LocalError(f"{what} must have a name after an IPv6 address, such as {what}={text},iort.lab")
    listen.check(what)
    return listen


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - a command's words to its user


if __name__ == "__main__":
    main()
