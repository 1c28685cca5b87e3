"""Looks into a recording as far as needed to know that it can be played."""

from __future__ import annotations

import threading
from typing import NamedTuple

from iort_agent.common.threads import brief
from iort_agent.errors import SourceError
from iort_agent.sources.recording.player import Open
from iort_contract.catalog.streams import TYPES_STREAM


class Looked(NamedTuple):
    """``streams`` have a message; ``ended`` is true if the recording ended before all wanted streams had one;
    ``error`` is empty if nothing is wrong."""

    streams: list[str]
    ended: bool
    error: str


def look_into(recording: Open, wanted: set[str], within_s: float) -> Looked:
    """Read until every wanted stream has a message, or the time is over."""
    streams: set[str] = set()
    errors: list[str] = []
    ended, done, stop = threading.Event(), threading.Event(), threading.Event()

    def look() -> None:
        try:
            with recording() as messages:
                for message in messages:
                    if message.stream != TYPES_STREAM:
                        streams.add(message.stream)
                    if wanted <= streams or stop.is_set():
                        return
                ended.set()
        except SourceError as error:
            errors.append(str(error))
        except Exception as error:  # noqa: BLE001 - a bag library may raise anything
            errors.append(f"{type(error).__name__}: {error}")
        finally:
            done.set()

    # A large index is read in one call, which only the end of the process can interrupt.
    brief("check", look)
    done.wait(within_s)
    stop.set()
    return Looked(sorted(streams.copy()), ended.is_set(), errors[0] if errors else "")
