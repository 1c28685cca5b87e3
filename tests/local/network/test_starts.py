"""Starts of a cloud at which the emulator ends: it is started again, or the start says why not."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading

import pytest

from local.cloud import EmbeddedCloud
from local.processes import LocalError
from local.up import commands, run
from tests.local.persistence.emulators import Emulator


def test_an_emulator_whose_broker_cannot_listen_ends(tmp_path):
    emulator = Emulator(tmp_path)
    with (
        socket.create_server(("127.0.0.1", emulator.mqtt_port)),
        pytest.raises(LocalError, match=f"the broker cannot listen on port {emulator.mqtt_port}"),
    ):
        emulator.start()
    assert emulator.process.poll() == os.EX_UNAVAILABLE


@pytest.fixture
def up(tmp_path, monkeypatch):
    """Start a kept cloud of a class, whose deployment fails."""

    def deploy(*_given, **_settings):
        raise LocalError("cdk deploy failed")

    def start(cloud):
        monkeypatch.setattr(run, "EmbeddedCloud", cloud)
        monkeypatch.setattr("local.cloud.deploy", deploy)
        options = ["--state", str(tmp_path), "--ports", "any"]
        given = commands.parser("up", "", remembered=True).parse_args(options)
        run._Kept(given, threading.Event()).run()

    return start


def test_an_emulator_that_is_killed_before_the_cloud_is_up_is_started_again_a_few_times(up):
    starts = []

    class Killed(EmbeddedCloud):
        def start_emulator(self, *given):
            super().start_emulator(*given)
            starts.append(self.emulator.pid)
            os.kill(self.emulator.pid, signal.SIGKILL)

    with pytest.raises(
        LocalError, match=r"(?s)emulator was ended by SIGKILL.*It ended 3 times within 10 min"
    ):
        up(Killed)
    assert len(starts) == 3


def test_a_cloud_that_loses_its_port_at_the_first_start_takes_and_keeps_another(up, tmp_path):
    others = []

    class Second(EmbeddedCloud):
        def start_emulator(self, *given):
            if not others:
                # Another cloud that has found the same port free.
                others.append(socket.create_server((self.host, self.ports["mqtt"])))
            super().start_emulator(*given)

    with pytest.raises(LocalError, match="cdk deploy failed"):
        up(Second)
    with others[0] as other:
        kept = json.loads((tmp_path / "settings.json").read_text())["ports"]["mqtt"]
        assert kept != other.getsockname()[1]
