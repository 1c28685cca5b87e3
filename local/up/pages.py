"""The pages of a kept cloud: one for this machine, and with ``PAGE=`` one for a network."""

from __future__ import annotations

import ssl
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any

from typing_extensions import Self

from iort_contract.cloud import IOT
from iort_station import kept
from iort_station.cloud import Cloud
from iort_station.fleet import registry
from iort_station.page import answers as control
from iort_station.page.answers import actions, answers
from iort_station.page.history import downloads
from iort_station.page.motion import prompt, reaching
from iort_station.page.server import PageServer
from local.cloud import EmbeddedCloud
from local.network.listen import Listen
from local.up.login import Password
from local.up.network_page import SOCKET, NetworkPage


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
        # Robots come while it runs.
        "vehicles": lambda: registry.vehicles(prompt(cloud)),
        "answers": answers(cloud),
        "downloads": downloads(cloud),
        "open_actions": actions(cloud),
        "actions": control.keyed_actions(cloud),
    }
