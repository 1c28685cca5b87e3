"""Notes in the files' bucket what was imported, by the recording's content: a second import of it does
nothing, and an interrupted one goes on in the same way."""

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

_PREFIX = "imports/"
_CHUNK = 4 * 1024 * 1024
_ATTEMPTS = 3


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

    def _read(self, content: str) -> tuple[list[Import], dict[str, Any]]:
        """The imports, and the condition for writing over what was read."""
        try:
            answer = self._client.get_object(Bucket=self._bucket, Key=_key(content))
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
                f"{_key(content)} in the files' bucket is no note of an import: {error}"
            ) from error

    def note(self, content: str, one: Import) -> None:
        """Note an import, in place of what was noted of its robot and run."""
        for last in (False,) * _ATTEMPTS + (True,):
            there, condition = self._read(content)
            others = [each for each in there if (each.robot, each.run) != (one.robot, one.run)]
            body = json.dumps({"imports": [asdict(each) for each in (*others, one)]}, indent=1)
            try:
                self._client.put_object(
                    Bucket=self._bucket,
                    Key=_key(content),
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


def _key(content: str) -> str:
    return f"{_PREFIX}{content}.json"
