"""Notes in the files' bucket what was imported, by the recording's content: a second import of it does
nothing, and an interrupted one goes on in the same way. And, by robot, which imports are under way."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from botocore.exceptions import ClientError

from iort_contract.limits import ContractError
from iort_contract.objects import CHANGED, code_of
from iort_station.cloud import Cloud
from iort_station.errors import StationError

# A note's name is a content's hash, or begins with the second one and has a robot.
_PREFIX, _UNDER_WAY = "imports/", "under-way/"
_CHUNK = 4 * 1024 * 1024
_ATTEMPTS = 10


@dataclass(frozen=True)
class Import:
    """An import of a recording: its robot, its run, and its streams; where its batches are (``store``); the
    ``samples`` in all, when it was done (0: it was begun), and where the recording stopped being good."""

    robot: str
    run: str
    store: str
    streams: tuple[str, ...]
    name: str
    from_us: int
    to_us: int
    samples: int = 0
    done_ms: int = 0
    end: str = ""


def shared(one: Import, other: Import) -> list[str]:
    """The streams that two imports have at the same time."""
    at_once = one.from_us < other.to_us and other.from_us < one.to_us
    return sorted(set(one.streams) & set(other.streams)) if at_once else []


def content_of(files: Sequence[Path], progress: Callable[[float], None]) -> str:
    """The SHA-256 of a recording's files."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as content:
            while chunk := content.read(_CHUNK):
                digest.update(chunk)
                progress(len(chunk))
    return digest.hexdigest()


class Ledger:
    """The notes."""

    def __init__(self, cloud: Cloud) -> None:
        self._client, self._bucket = cloud.client("s3"), cloud.output("storage", "FilesBucket")

    def of(self, content: str) -> list[Import]:
        """The imports of a recording."""
        return self._read(content)[0]

    def _read(self, name: str) -> tuple[list[Import], dict[str, Any]]:
        """The imports, and the condition for writing over what was read."""
        try:
            answer = self._client.get_object(Bucket=self._bucket, Key=_key(name))
        except ClientError as error:
            if code_of(error) in {"NoSuchKey", "404"}:
                return [], {"IfNoneMatch": "*"}
            raise
        try:
            notes = json.loads(answer["Body"].read())["imports"]
            imports = [Import(**{**one, "streams": tuple(one["streams"])}) for one in notes]
            return imports, {"IfMatch": answer["ETag"]}
        except (ContractError, KeyError, TypeError, ValueError) as error:
            raise StationError(
                f"{_key(name)} in the files' bucket is no note of an import: {error}"
            ) from error

    def note(self, content: str, one: Import) -> None:
        """Note an import, in place of what was noted of its robot and run."""
        self._change(content, one, lambda others: [*others, one])

    def begin(self, one: Import, *, overlap: bool) -> Import | None:
        """Note that an import is under way, unless it overlaps another one that is: returns that one. Two
        that begin at once cannot miss each other."""
        against: list[Import] = []

        def change(others: list[Import]) -> list[Import] | None:
            against[:] = () if overlap else [each for each in others if shared(each, one)]
            return None if against else [*others, one]

        self._change(_UNDER_WAY + one.robot, one, change)
        return against[0] if against else None

    def end(self, one: Import) -> None:
        """Note that an import is under way no longer."""
        self._change(_UNDER_WAY + one.robot, one, lambda others: others)

    def _change(self, name: str, one: Import, change: Callable[[list[Import]], list[Import] | None]) -> None:
        """Change the imports of a note, given those but ``one``; None leaves them."""
        for last in (False,) * _ATTEMPTS + (True,):
            there, condition = self._read(name)
            after = change([each for each in there if (each.robot, each.run) != (one.robot, one.run)])
            if after is None:
                return
            body = json.dumps({"imports": [asdict(each) for each in after]}, indent=1)
            try:
                self._client.put_object(
                    Bucket=self._bucket,
                    Key=_key(name),
                    Body=body.encode(),
                    ContentType="application/json",
                    **condition,
                )
            except ClientError as error:
                # Another import of the recording has noted itself.
                if code_of(error) not in CHANGED or last:
                    raise
            else:
                return

    def done(self, content: str, one: Import, samples: int, end: str) -> None:
        """Note that an import is done."""
        now_ms = time.time_ns() // 1_000_000
        self.note(content, replace(one, samples=samples, done_ms=now_ms, end=end))


def _key(name: str) -> str:
    return f"{_PREFIX}{name}.json"
