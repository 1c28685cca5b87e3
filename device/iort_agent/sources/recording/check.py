"""Looks into a recording as far as it takes to know that it can be played."""

from __future__ import annotations

import threading
from typing import NamedTuple

from iort_agent.errors import SourceError
from iort_agent.sources.recording.bag import BagSource
from iort_contract.catalog.streams import TYPES_STREAM


class Looked(NamedTuple):
    """The streams of which a message was read; whether the recording ended before all wanted ones were; and
    what is wrong with it, empty where nothing is known to be."""

    streams: list[str]
    ended: bool
    error: str


def look_into(source: BagSource, wanted: set[str], within_s: float) -> Looked:
    """Open the recording and read until a message of every wanted stream has come, or the time is over."""
    streams: set[str] = set()
    errors: list[str] = []
    ended, done, stop = threading.Event(), threading.Event(), threading.Event()

    def look() -> None:
        try:
            with source.open() as messages:
                for message in messages:
                    if message.stream != TYPES_STREAM:
                        streams.add(message.stream)
                    if wanted <= streams or stop.is_set():
                        return
                ended.set()
        except SourceError as error:
            errors.append(str(error))
        except Exception as error:  # noqa: BLE001 - whatever a bag library raises
            errors.append(f"{type(error).__name__}: {error}")
        finally:
            done.set()

    # A large index is read in one go, which nothing but the end of the process can break off.
    threading.Thread(target=look, name="check", daemon=True).start()
    done.wait(within_s)
    stop.set()
    return Looked(sorted(streams.copy()), ended.is_set(), errors[0] if errors else "")
