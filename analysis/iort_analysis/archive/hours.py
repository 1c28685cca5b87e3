"""The archive's manifest and its hours as they are in the bucket, for whoever reads them."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from heapq import merge
from itertools import groupby
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, TypeVar, cast

from iort_analysis import ArchiveError
from iort_analysis.samples.batches import Item, Part, RefusedItems, Wanted, batches_of
from iort_analysis.samples.blocks import join, values
from iort_contract.archive import (
    HOUR,
    ArchivedHour,
    ArchiveTable,
    archived_hour,
    hour_of,
    hours_between,
    parse_hour,
    refused_key,
)
from iort_contract.checks import shown
from iort_contract.dynamodb import ALL, Keys, TelemetryTable, plain
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, batch_id, run_ends
from iort_contract.objects import code_of
from iort_contract.tables import BATCH, NONFINITE, PREVIOUS, SAMPLES
from iort_contract.topics import parse_topic

if TYPE_CHECKING:
    from iort_analysis.archive.reading import ArchiveFile

# The table's items of an hour are no longer taken for complete this long before the first one expires: no
# command reads for longer.
_BEFORE_EXPIRY_S = 86_400
# An hour up to this size is read by one request, also if few of its fields are needed: a request for each
# field takes longer. An hour of thirty fields at 50 Hz has some 3 MB.
_AT_ONCE_BYTES = 8_000_000
# The end of a day's file, which tells where the hours are.
_END_BYTES = 256 * 1024
_GONE = frozenset({"404", "NoSuchKey", "412", "PreconditionFailed"})
# What reading a damaged file raises: pyarrow's errors are of these. Those of the network are none of them.
DAMAGED = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
_T = TypeVar("_T")
_Item = TypeVar("_Item", bound=Item)


class Stores(NamedTuple):
    """Where recordings are. Without ``manifest`` there is no archive; ``files`` makes boto3's client of S3
    and the name of the bucket, when the first object is read."""

    telemetry: TelemetryTable
    manifest: ArchiveTable | None
    files: Callable[[], tuple[Any, str]]


class Archive:
    """The archive of one topic. ``refused`` gets the manifest's rows that are damaged."""

    def __init__(self, stores: Stores, topic: str, refused: RefusedItems | None = None) -> None:
        self._stores, self._topic = stores, topic
        self._refused = RefusedItems() if refused is None else refused

    def rows(
        self, first_us: int | None = None, last_us: int | None = None, *, newest_first: bool = False
    ) -> Iterator[ArchivedHour]:
        """The archived hours that have batches which start between two times, both inclusive; in order of
        time."""
        if self._stores.manifest is None:
            return
        first, last = (None if t_us is None else hour_of(max(0, t_us)) for t_us in (first_us, last_us))
        keys = hours_between(first, last)
        for page in self._stores.manifest.pages(self._topic, keys, newest_first=newest_first):
            for item in page.items:
                try:
                    row = archived_hour(item)
                    parse_hour(row.hour)
                except ContractError as error:  # noqa: PERF203 - each row is refused by itself
                    self._refused.add(error, f"the archive's row {item.get(HOUR, {}).get('S', '')}")
                else:
                    yield row

    def read(self, row: ArchivedHour, use: Callable[[HourFile], _T]) -> _T:
        """What ``use`` makes of an hour's file.

        A file may be replaced or joined with a day's others while it is read; it is then read again. Raises
        `ArchiveError` if it is missing or damaged.
        """
        problem: Exception | None = None
        for _ in range(2):
            try:
                return use(HourFile(self._stores, row))
            except Exception as error:  # noqa: PERF203 - it is tried twice, whatever S3's client is
                if not isinstance(error, DAMAGED) and code_of(error) not in _GONE:
                    raise
                problem = error
                hour = parse_hour(row.hour)
                row = next(self.rows(hour.start_us, hour.start_us), row)
        what = "is damaged" if isinstance(problem, DAMAGED) else "is missing"
        raise ArchiveError(
            f"the archive's {row.key or row.hour} of {self._topic} {what}: run `iort archive verify`"
        ) from problem


def is_expiring(row: ArchivedHour) -> bool:
    """Whether the table may lack items of the hour."""
    return row.first_expires_s < time.time() + _BEFORE_EXPIRY_S


def merged(*sources: Iterable[_Item]) -> Iterator[_Item]:
    """The items of sources in the order of their keys, each key once: of the first source that has it."""
    for _, same in groupby(merge(*sources, key=key_of), key_of):
        yield next(same)


def within(items: Iterable[Item], keys: Keys) -> list[Item]:
    """The items with these keys."""
    return [item for item in items if keys.first["S"] <= key_of(item) <= keys.last["S"]]


def key_of(item: Item) -> str:
    """The key of an item."""
    key = item[BATCH]["S"]
    if not isinstance(key, str):
        raise TypeError(f"{BATCH} must be a text, got {shown(key)}")
    return key


class HourFile:
    """An hour of the archive, to be read."""

    def __init__(self, stores: Stores, row: ArchivedHour) -> None:
        self._row, self._hour = row, parse_hour(row.hour)
        self._client, self._bucket = stores.files()

    def parts(self, wanted: Wanted, *, messages: bool, keys: Keys) -> list[Part]:
        """The samples of the batches with these keys, in the order of the batches."""
        return list(self._file.pages(self._hour, wanted, keys=keys, messages=messages))

    def batches(self, wanted: Wanted, keys: Keys) -> list[Batch]:
        """The batches with these keys."""
        if self._row.batches and self._file.has_messages(self._hour):
            # Values that were not finite are counted as messages are decoded.
            return list(batches_of(self.items(keys), wanted))
        block = join([part.block for part in self.parts(wanted, messages=True, keys=keys)])
        times, columns = block.times_us.tolist(), {n: values(column) for n, column in block.columns.items()}
        batches, first = [], 0
        for item in map(plain, within(self.headers(), keys)):
            key, rows = batch_id(item[BATCH]), slice(first, first + int(item[SAMPLES]))
            previous = run_ends(item[PREVIOUS]) if PREVIOUS in item else None
            own = {name: column[rows] for name, column in columns.items()}
            nonfinite = int(item.get(NONFINITE, 0))
            batches.append(Batch(key.boot, key.seq, times[rows], own, nonfinite, None, previous))
            first = rows.stop
        return batches

    def headers(self) -> list[Item]:
        """The batches without their samples, as stored items."""
        return list(self._file.headers(self._hour)) if self._row.batches else []

    def ids(self) -> list[str]:
        """The ids of everything that was stored, in order."""
        batches = [key for key, _ in self._file.hashes(self._hour)] if self._row.batches else []
        return sorted([*batches, *map(key_of, self._refused())])

    def items(self, keys: Keys = ALL) -> list[Item]:
        """Everything that was stored with these keys, in order; what is not a batch byte for byte."""
        # It takes longer to load than most commands to run.
        from iort_analysis.archive.reading import items  # noqa: PLC0415 - see above

        batches = items(self._file, self._row.topic, self._hour, keys) if self._row.batches else ()
        return sorted([*batches, *within(self._refused(), keys)], key=key_of)

    @cached_property
    def _file(self) -> ArchiveFile:
        from iort_analysis.archive.reading import ArchiveFile  # noqa: PLC0415 - as above

        if self._row.size_bytes <= _AT_ONCE_BYTES:
            return ArchiveFile(self._get(self._row.key))
        ranges = _Ranges(self._client, self._bucket, self._row.key)
        file = ArchiveFile(cast("BinaryIO", ranges))
        start, end = file.span(self._hour)
        if end - start <= _AT_ONCE_BYTES:
            # One request takes less time than one for each column.
            ranges.keep(start, end)
        return file

    def _refused(self) -> list[Item]:
        if not self._row.refused:
            return []
        lines = self._get(refused_key(parse_topic(self._row.topic), self._hour)).splitlines()
        return [json.loads(line) for line in lines]

    def _get(self, key: str) -> bytes:
        return bytes(self._client.get_object(Bucket=self._bucket, Key=key)["Body"].read())


class _Ranges(io.RawIOBase):
    """An object as a file, of which only what is asked for is read."""

    def __init__(self, client: Any, bucket: str, key: str) -> None:
        self._client, self._of = client, {"Bucket": bucket, "Key": key}
        answer = client.get_object(**self._of, Range=f"bytes=-{_END_BYTES}")
        # An object that is replaced in between is an error, and no mixture.
        self._of["IfMatch"] = answer["ETag"]
        self._size, self._at = int(answer["ContentRange"].rpartition("/")[2]), 0
        end: bytes = answer["Body"].read()
        self._kept = [(self._size - len(end), end)]

    def keep(self, start: int, end: int) -> None:
        """Read a part that will be asked for."""
        self._kept.append((start, self._get(start, end)))

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def readinto(self, into: Any) -> int:
        end = min(self._at + len(into), self._size)
        if end <= self._at:
            return 0
        body = self._part(self._at, end)
        into[: len(body)] = body
        self._at += len(body)
        return len(body)

    def _part(self, start: int, end: int) -> bytes:
        for first, body in self._kept:
            if first <= start and end <= first + len(body):
                return body[start - first : end - first]
        return self._get(start, end)

    def _get(self, start: int, end: int) -> bytes:
        return bytes(self._client.get_object(**self._of, Range=f"bytes={start}-{end - 1}")["Body"].read())
