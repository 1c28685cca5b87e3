"""A disk that fails with POWER_CUT=1: the emulator ends, and the next one has what was acknowledged."""

from __future__ import annotations

import os
import signal

from botocore.exceptions import BotoCoreError

from testkit.waiting import GUARD_S, until
from tests.local.persistence.emulators import Emulator


class Failing(Emulator):
    """From a SIGUSR1 on, its disk fails."""

    sync = "full"
    arguments = (
        "-c",
        """
import os, signal
from local.emulator.run import main

def fails(_file):
    raise OSError(5, "Input/output error")

signal.signal(signal.SIGUSR1, lambda *_: setattr(os, "fdatasync", fails))
main()
""",
    )


def test_a_disk_that_fails_ends_the_emulator_and_the_next_one_goes_on(tmp_path):
    emulator = Failing(tmp_path)
    emulator.start()
    try:
        emulator.client("ssm").put_parameter(Name="before", Value="kept", Type="String")
        os.kill(emulator.process.pid, signal.SIGUSR1)

        def is_refused() -> bool:
            try:
                emulator.client("ssm").put_parameter(
                    Name="after", Value="unknown", Type="String", Overwrite=True
                )
            except BotoCoreError:
                return True
            return False

        until(is_refused)
        assert emulator.process.wait(GUARD_S) == os.EX_IOERR
        assert "fails: [Errno 5] Input/output error; start again" in emulator.process.tail()
        emulator.restart()
        assert emulator.client("ssm").get_parameter(Name="before")["Parameter"]["Value"] == "kept"
    finally:
        emulator.kill()
