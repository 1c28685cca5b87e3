"""The password of the page in the network, its sessions, and how often it may be tried."""

from __future__ import annotations

import io

import pytest
from argon2 import PasswordHasher

from iort_station.errors import StationError
from iort_station.page.password import ALL_TRIES, ALL_TRY_S, TRIES, TRY_S, Password, Tries, first_password
from local.up import network_page
from local.up.network_page import Sessions

# A real hash takes 64 MB and a tenth of a second.
QUICK = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


class Now:
    def __init__(self):
        self.s = 1000.0

    def __call__(self):
        return self.s


class Output(io.StringIO):
    def __init__(self, *, terminal: bool) -> None:
        super().__init__()
        self._terminal = terminal

    def isatty(self) -> bool:
        return self._terminal


@pytest.mark.parametrize("terminal", [True, False])
def test_the_first_password_is_shown_to_a_terminal_alone(terminal):
    words = first_password("s3cret", "make up-password", Output(terminal=terminal))
    assert ("s3cret" in words, "`make up-password`" in words) == (terminal, True)


def test_a_password_is_made_once_and_kept_as_a_hash(tmp_path):
    password = Password(tmp_path, QUICK)
    made = password.make()
    assert password.make() is None
    (file,) = tmp_path.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert made not in file.read_text()
    assert file.read_text().startswith("$argon2id$")
    assert Password(tmp_path, QUICK).is_right(made)
    assert not password.is_right(made + "x")
    assert not password.is_right("")


@pytest.mark.parametrize("short", ["", "123456789", "x" * 1001])
def test_a_password_of_a_wrong_length_is_refused(tmp_path, short):
    with pytest.raises(StationError, match=r"must have 10 to 1000 characters, got \d+"):
        Password(tmp_path, QUICK).set(short)


def test_a_long_guess_is_not_hashed_and_a_damaged_file_lets_nobody_in(tmp_path):
    class Counting(PasswordHasher):
        def verify(self, kept, told):
            guesses.append(told)
            return super().verify(kept, told)

    guesses: list[str] = []
    password = Password(tmp_path, Counting(time_cost=1, memory_cost=8, parallelism=1))
    made = password.make()
    assert not password.is_right("x" * 1001)
    assert guesses == []
    (file,) = tmp_path.iterdir()
    file.write_text("half")
    assert not password.is_right(made)


def test_an_address_waits_after_its_tries_and_others_do_not():
    now = Now()
    tries = Tries(now)
    assert [tries.wait_s("192.0.2.1") for _ in range(TRIES)] == [0.0] * TRIES
    assert tries.wait_s("192.0.2.1") == pytest.approx(TRY_S)
    assert tries.wait_s("192.0.2.2") == 0.0
    now.s += TRY_S
    assert tries.wait_s("192.0.2.1") == 0.0
    assert tries.wait_s("192.0.2.1") > 0.0


def test_the_addresses_of_one_ipv6_network_share_their_tries():
    tries = Tries(Now())
    assert [tries.wait_s(f"2001:db8::{i}") for i in range(TRIES)] == [0.0] * TRIES
    assert tries.wait_s("2001:db8::ffff") > 0.0


def test_some_addresses_together_leave_tries_to_others():
    tries = Tries(Now())
    busy = [f"192.0.2.{i}" for i in range(10)]
    made = sum(tries.wait_s(address) == 0.0 for address in busy for _ in range(TRIES))
    assert made < ALL_TRIES < len(busy) * TRIES
    assert tries.wait_s(busy[0]) > 0.0
    assert tries.wait_s("198.51.100.1") == 0.0


def test_all_addresses_together_have_an_end_too():
    tries = Tries(Now())
    waits = [tries.wait_s(f"192.0.2.{i}") for i in range(ALL_TRIES + 1)]
    assert waits[:-1] == [0.0] * ALL_TRIES
    assert waits[-1] == pytest.approx(ALL_TRY_S)


def test_a_session_ends_when_nobody_uses_it():
    now = Now()
    sessions = Sessions(now)
    used, left = sessions.begin(), sessions.begin()
    now.s += network_page.SESSION_S - 1
    assert sessions.goes_on(used)
    now.s += 2
    assert sessions.goes_on(used)
    assert not sessions.goes_on(left)
    assert not sessions.goes_on("")
    sessions.end(used)
    assert not sessions.goes_on(used)


def test_sessions_are_bounded_and_the_longest_unused_ends_first(monkeypatch):
    monkeypatch.setattr(network_page, "_MOST_SESSIONS", 2)
    sessions = Sessions(Now())
    first, second = sessions.begin(), sessions.begin()
    assert sessions.goes_on(first)
    third = sessions.begin()
    assert [sessions.goes_on(one) for one in (first, second, third)] == [True, False, True]
