"""A spool's files: the database and the numbers beside it, opened, set aside when damaged, begun anew."""

from __future__ import annotations

import logging
import sqlite3
import threading
from pathlib import Path

from iort_agent.clock import Clock
from iort_agent.errors import AgentError
from iort_agent.spool.file import Content, SpoolFile, is_damage, remove, salvage, set_aside
from iort_agent.spool.memory import FULL, Dropped
from iort_agent.spool.reservation import BLOCK, BLOCK_ADRIFT, Reservation
from iort_agent.spool.stock import Group, Stock

_log = logging.getLogger(__name__)


class SpoolDisk:
    """The files of a spool whose batches ``stock`` knows, under ``lock``.

    ``file`` is None where the disk has not worked yet; ``damage`` says what was wrong with a file.
    One thread at a time uses it.
    """

    def __init__(
        self,
        path: Path,
        *,
        stock: Stock,
        lock: threading.Condition,
        durability: str,
        clock: Clock,
        max_file_bytes: int | None,
    ) -> None:
        self._path, self._stock, self._lock = path, stock, lock
        self._durability, self._clock, self._max_file_bytes = durability, clock, max_file_bytes
        self._numbers: Reservation | None = None
        self.file: SpoolFile | None = None
        self.damage: str | None = None
        self._set_aside_first = False

    def open(self) -> None:
        """Take the files, and go on where the run before ended.

        Raises `AgentError` where they are another's, `OSError` or `sqlite3.Error` where the disk does
        not work.
        """
        if self._numbers is None:
            self._numbers = Reservation(self._path.with_name(f"{self._path.name}.seq"))
        before, machine = self._numbers.state, _machine()
        power_cut = not before.get("clean", True) and before.get("machine") != machine
        # Whether numbers may have been used that the database does not know of.
        astray = (
            bool(before.get("adrift"))
            or (power_cut and before.get("durability") != FULL)
            or not self._path.exists()
        )
        try:
            if astray:
                # Before a new file is made, which by itself would look like one that can be trusted.
                self._numbers.write(adrift=True)
            file, content = self._connect_and_load(check=power_cut)
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            if not self._numbers.existed:
                # It was never ours, so it must not be moved away.
                raise AgentError(f"{self._path}: {error}: give queue.path another name") from error
            self._numbers.write(adrift=True)
            aside = set_aside(self._path, self._clock.now_us())
            file = self._connect(self._path)
            salvaged = salvage(aside, file)
            content = file.load()
            astray = True
            with self._lock:
                self._stock.count_dropped(len(salvaged.lost), sum(salvaged.lost.values()))
            self._tell_damage(error, aside, saved=len(salvaged.saved), lost=len(salvaged.lost))
        self._set_aside_first = False
        self._take_over(file, content, astray=astray)
        with self._lock:
            seqs, dropped = dict(self._stock.seqs), self._stock.dropped_ever()
        # The database first: as long as it does not know where to go on, the file of numbers says so.
        file.commit([], seqs=seqs, dropped=dropped)
        self._numbers.write(clean=False, adrift=False, machine=machine, durability=self._durability)
        self.file = file

    def reopen(self, *, full: bool) -> None:
        """After a failure: an open file may have to be opened again to work again, unless the disk was
        only ``full``."""
        if self.file is None:
            self.open()
        elif not full:
            fresh = self._connect(self._path)
            self.file.abandon()
            self.file = fresh

    def write(self, group: Group) -> None:
        """One transaction, its numbers reserved before."""
        assert self.file is not None
        self._reserve(group.seqs, BLOCK)
        self.file.commit(group.entries, gone=group.gone, seqs=group.seqs, dropped=group.dropped)

    def note_adrift(self) -> None:
        """Note, if that works, that numbers get used that the database does not know of."""
        with self._lock:
            seqs = dict(self._stock.seqs)
        try:
            if self._numbers is not None:
                self._reserve(seqs, BLOCK_ADRIFT, left=BLOCK_ADRIFT // 2, adrift=True)
        except OSError as error:
            _log.debug("queue: the numbers cannot be noted either: %s", error)

    def note_settled(self) -> None:
        """Note that the database knows every number again."""
        assert self._numbers is not None
        self._numbers.write(adrift=False)

    def replace(self, error: Exception, *, adrift: bool) -> Exception | None:
        """Set the damaged file aside and begin a new one with what can still be read; what stood in the
        way of that. ``adrift`` says whether numbers are used that no database knows of."""
        with self._lock:
            on_disk = self._stock.on_disk()
        old, self.file = self.file, None
        removed = old is not None and not old.in_place()
        if old is not None and not removed:
            old.abandon()
        saved: set[int] = set()
        trouble: Exception | None = None
        where: Path | None = None
        self._set_aside_first = True
        try:
            if self._numbers is not None:
                self._numbers.write(adrift=True)
            if old is not None and removed:
                saved = self._rescue(old, on_disk)
            where = set_aside(self._path, self._clock.now_us())
            if old is not None and removed:
                self._rescued.replace(self._path)
            self._set_aside_first = False
            file = self._connect(self._path)
            if not removed:
                saved = set(salvage(where, file, on_disk).saved)
            with self._lock:
                seqs = dict(self._stock.seqs)
            file.commit([], seqs=seqs)
            if self._numbers is not None and not adrift:
                self._numbers.write(adrift=False)
            self.file = file
        except (OSError, sqlite3.Error) as another:
            # What could be saved is found when the file is opened again.
            trouble, saved = another, set()
        with self._lock:
            lost = self._stock.keep_only(saved, on_disk)
        self._tell_damage(error, where, saved=len(saved), lost=lost)
        return trouble

    def settle(self) -> None:
        """Close in good order: everything in the one file, and the numbers to be trusted."""
        if self.file is None:
            return
        self.file.close()
        self.file = None
        if self._numbers is not None:
            self._numbers.write(clean=True)

    def close(self) -> None:
        """Let go of the files as they are."""
        if self.file is not None:
            self.file.abandon()
        if self._numbers is not None:
            self._numbers.close()
        self.file = self._numbers = None

    def _connect(self, path: Path) -> SpoolFile:
        return SpoolFile(path, durability=self._durability, max_file_bytes=self._max_file_bytes)

    def _connect_and_load(self, *, check: bool) -> tuple[SpoolFile, Content]:
        if self._set_aside_first:
            raise sqlite3.DatabaseError("it could not be read")
        file = self._connect(self._path)
        try:
            if check:
                file.check()
            return file, file.load()
        except BaseException:
            file.abandon()
            raise

    def _take_over(self, file: SpoolFile, content: Content, *, astray: bool) -> None:
        assert self._numbers is not None
        batches, numbers = content.batches, self._numbers
        with self._lock:
            offset = self._stock.ids_behind(batches)
            if offset:
                file.move_ids(offset)
                batches = [(entry_id + offset, size, samples) for entry_id, size, samples in batches]
            dropped, floor, seqs = content.dropped, None, content.seqs
            if astray:
                dropped = max(dropped, Dropped(*numbers.state.get("dropped", (0, 0))))
                floor = numbers.reserved("")
                seqs = {
                    stream: max(seqs.get(stream, 0), numbers.reserved(stream))
                    for stream in {*numbers.streams(), *seqs}
                }
            self._stock.take_over(batches, dropped)
            self._stock.go_on_from(seqs, floor=floor)

    @property
    def _rescued(self) -> Path:
        return self._path.with_name(f"{self._path.name}.new")

    def _rescue(self, old: SpoolFile, ids: list[int]) -> set[int]:
        """Copy the batches from a file that was removed, which who has it open can still read.

        Under another name, because SQLite removes a log by its name when it closes the old file.
        """
        remove(self._rescued)
        file = self._connect(self._rescued)
        try:
            saved = set(salvage(old, file, ids).saved)
            file.close()
        finally:
            file.abandon()
        return saved

    def _tell_damage(self, error: Exception, aside: Path | None, *, saved: int, lost: int) -> None:
        there = aside is not None and aside.exists()
        where = f"set aside as {aside.name}" if aside is not None and there else "begun anew"
        text = (
            f"the queue's file was damaged ({error}) and {where}: {saved} batches saved, at least {lost} lost"
        )
        _log.error("%s: %s", self._path, text)
        with self._lock:
            self.damage = text

    def _reserve(self, seqs: dict[str, int], block: int, *, left: int = 0, **facts: object) -> None:
        """Have more numbers reserved for the streams of which no more than ``left`` are."""
        assert self._numbers is not None
        numbers = self._numbers
        reserve = {
            stream: seq + block for stream, seq in seqs.items() if seq + left > numbers.reserved(stream)
        }
        if reserve or any(numbers.state.get(name) != fact for name, fact in facts.items()):
            numbers.write(reserve=reserve, dropped=self._stock.dropped_ever(), **facts)


def _machine() -> str:
    """Which run of the machine it is: another one after a power cut."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
