"""The password of what this machine serves to a network, the page and the bridge, and how often it may be
tried."""

from __future__ import annotations

import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from argon2 import PasswordHasher, extract_parameters
from argon2.exceptions import InvalidHashError, VerificationError

from iort_station.errors import StationError
from iort_station.output import write_private
from iort_station.page.places import client_of

LEAST_CHARACTERS = 10
_MOST_CHARACTERS = 1_000
# An address may try so often at once, and once more each time these seconds have passed. So may all together;
# a share of these tries is for addresses that have not tried yet.
TRIES, TRY_S = 5, 30.0
ALL_TRIES, ALL_TRY_S = 30, 2.0
FIRST_TRIES = ALL_TRIES // 2
_MOST_ADDRESSES = 10_000
_FILE = "page-password"


class Password:
    """The hash of a password, by argon2id, in a file that only its owner reads."""

    def __init__(self, folder: Path, hasher: PasswordHasher | None = None) -> None:
        self._path, self._hasher = folder / _FILE, hasher or PasswordHasher()

    def make(self) -> str | None:
        """Make a random password unless there is one; returns a new one, which nobody can read later. Raises
        `StationError` if the file is damaged."""
        if self._path.exists():
            self._check()
            return None
        new = secrets.token_urlsafe(12)
        self.set(new)
        return new

    def set(self, new: str) -> None:
        """Change the password; raises `StationError` for one that is too short or too long."""
        if not LEAST_CHARACTERS <= len(new) <= _MOST_CHARACTERS:
            raise StationError(
                f"the password must have {LEAST_CHARACTERS} to {_MOST_CHARACTERS} characters, got {len(new)}"
            )
        write_private(self._path, self._hasher.hash(new).encode())

    def is_right(self, told: str) -> bool:
        """Whether it is the password; takes a tenth of a second, so that guesses take time."""
        if len(told) > _MOST_CHARACTERS:
            return False
        try:
            return self._hasher.verify(self._path.read_text(), told)
        except (VerificationError, InvalidHashError):
            return False

    def _check(self) -> None:
        text = self._path.read_text(errors="replace")
        with suppress(InvalidHashError):
            if extract_parameters(text).hash_len == self._hasher.hash_len:
                return
        raise StationError(
            f"{self._path} must have a hash of argon2, got {text[:40]!r}: `make up-password` sets another"
        )

    def version(self) -> int:
        """Changes with the password."""
        return self._path.stat().st_mtime_ns


def first_password(new: str, command: str, output: TextIO) -> str:
    """What is told of a password that was just made: a terminal alone is told which. Others can read what
    goes into a file or a journal."""
    if output.isatty():
        return f"password {new} (shown once; `{command}` sets another)"
    return f"password is not shown here: `{command}` sets one"


class Tries:
    """How often an address may still try a password."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._of_all = (float(ALL_TRIES), now())

    def wait_s(self, address: str) -> float:
        """Count a try; returns 0, or the seconds until the next one, and then it must not be made."""
        now, client = self._now(), client_of(address)
        own = _filled(self._left.get(client, (float(TRIES), now)), now, TRIES, TRY_S)
        of_all = _filled(self._of_all, now, ALL_TRIES, ALL_TRY_S)
        kept = 0 if own == TRIES else FIRST_TRIES
        wait_s = max((1 - own) * TRY_S, (1 + kept - of_all) * ALL_TRY_S, 0.0)
        if wait_s > 0:
            return wait_s
        self._left[client], self._of_all = (own - 1, now), (of_all - 1, now)
        self._left.move_to_end(client)
        if len(self._left) > _MOST_ADDRESSES:
            self._left.popitem(last=False)
        return 0.0


def _filled(left: tuple[float, float], now: float, most: int, each_s: float) -> float:
    return min(float(most), left[0] + (now - left[1]) / each_s)
