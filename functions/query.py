"""Query: filters a range of samples in the cloud, so that only matching ones leave AWS.

The operator's `iort query --on lambda` invokes it. The answer is encoded like a batch; a large answer goes
through the files' bucket by a pre-signed address. An invocation stops before its time or memory runs out, and
returns a token to continue.
"""

from __future__ import annotations

import base64
import json
import os
import uuid
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import boto3
from botocore.config import Config

from functions.shared.tables import Tables
from iort_contract import expression
from iort_contract.cloud import RESULTS_PREFIX
from iort_contract.codec.columns import PLAIN_CODEC
from iort_contract.dynamodb import plain, with_samples_between
from iort_contract.expression import ExpressionError, MismatchError, Node
from iort_contract.limits import ContractError, Value
from iort_contract.messages.batch import decode_batch
from iort_contract.statistics import derive, without_absent
from iort_contract.tables import BATCH, TOPIC
from iort_contract.topics import RECORD, build_topic, parse_topic
from iort_contract.vesc import DERIVED_UNITS

# Lambda's synchronous answer holds 6 MB; the envelope around the samples takes some hundred bytes.
MAX_INLINE_BYTES = 5_500_000
# Python takes some 30 bytes a value, and encoding as much again.
MAX_VALUES = 6_000_000
# The last page is requested with at least this much time left: encoding and storing take no longer.
MARGIN_MS = 8_000
_URL_S = 900
_FIRST, _LAST = -(2**53), 2**53

Store = Callable[[bytes], str]
Left = Callable[[], int]


class RequestError(ValueError):
    """A request that cannot be answered; the text says why."""


@dataclass(frozen=True)
class Request:
    """A query for a topic's samples from ``start_us`` (inclusive) to ``end_us`` (exclusive).

    ``fields`` None means all. ``token`` comes from the previous answer and continues there.
    """

    topic: str
    start_us: int
    end_us: int
    fields: tuple[str, ...] | None
    condition: Node | None
    scan: bool
    token: dict[str, Any] | None

    def needs(self, name: str) -> bool:
        """Whether the answer needs this stored field."""
        deciding = expression.names(self.condition) if self.condition is not None else ()
        return self.fields is None or name in self.fields or name in deciding

    @classmethod
    def read(cls, event: Mapping[str, Any], namespace: str) -> Request:
        """Read the request from an event; raises `RequestError`."""
        try:
            where, fields = event.get("where"), event.get("fields")
            if fields is not None and not all(isinstance(name, str) for name in fields):
                raise RequestError(f"fields must be a list of names, got {fields!r}")
            return cls(
                topic=build_topic(RECORD, event["robot"], event["stream"], namespace),
                start_us=_time(event, "start_us", _FIRST),
                end_us=_time(event, "end_us", _LAST),
                fields=None if fields is None else tuple(fields),
                condition=None if where is None else expression.parse(where),
                scan=bool(event.get("scan")),
                token=event.get("token"),
            )
        except KeyError as error:
            raise RequestError(f"the request has no {error.args[0]}") from error
        except (ContractError, ExpressionError, TypeError, AttributeError) as error:
            raise RequestError(str(error)) from error


def _time(event: Mapping[str, Any], key: str, otherwise: int) -> int:
    value = event.get(key)
    if value is None:
        return otherwise
    if type(value) is not int:
        raise RequestError(f"{key} must be an integer of microseconds, got {value!r}")
    return max(_FIRST, min(_LAST, value))


class Found:
    """The matching samples, as growing lists."""

    def __init__(self, request: Request, tables: Tables) -> None:
        self._request = request
        named = set(request.fields or ())
        if request.condition is not None:
            named |= expression.names(request.condition)
        self._derived = sorted(named & DERIVED_UNITS.keys())
        self._vehicle = tables.vehicle(parse_topic(request.topic).robot) if self._derived else None
        self.times_us: list[int] = []
        self.columns: dict[str, list[Value]] = {}
        self.there: dict[str, None] = {}
        self.refused = 0
        self.reason = ""
        # Values of absent sensors, by field.
        self.absent: Counter[str] = Counter()

    @property
    def values(self) -> int:
        """The number of values held."""
        return len(self.times_us) * (1 + len(self.columns))

    def add(self, item: Mapping[str, Any]) -> None:
        """Add the matching samples of a stored item."""
        request = self._request
        try:
            batch = decode_batch(item)
        except ContractError as error:
            self.refused += 1
            self.reason = self.reason or str(error)
            return
        times = batch.times_us
        chosen = [i for i, t_us in enumerate(times) if request.start_us <= t_us < request.end_us]
        if not chosen:
            return
        known, absences = without_absent(batch.columns)
        columns = dict(known)
        for name in absences:
            self.absent[name] += sum(batch.columns[name][i] != columns[name][i] for i in chosen)
        if self._derived:
            made = derive(columns, self._vehicle)
            columns |= {name: made[name] for name in self._derived if name in made}
        self.there |= dict.fromkeys(columns)
        if request.condition is not None:
            deciding = expression.names(request.condition) & columns.keys()
            inside = {name: [columns[name][i] for i in chosen] for name in deciding}
            holds = expression.holds(request.condition, inside, len(chosen))
            chosen = [i for i, is_in in zip(chosen, holds, strict=True) if is_in]
            if not chosen:
                return
        names = batch.columns if request.fields is None else request.fields
        before = len(self.times_us)
        self.times_us += [times[i] for i in chosen]
        for name in names:
            self.columns.setdefault(name, [None] * before)
        for name, column in self.columns.items():
            source = columns.get(name) if name in names else None
            column.extend([None] * len(chosen) if source is None else [source[i] for i in chosen])


def answer(
    event: Mapping[str, Any],
    tables: Tables,
    store: Store,
    left_ms: Left,
    *,
    namespace: str,
    max_values: int = MAX_VALUES,
    max_inline_bytes: int = MAX_INLINE_BYTES,
) -> dict[str, Any]:
    """Answer one request. ``store`` keeps bytes and returns their address; ``left_ms`` returns the
    invocation's remaining time."""
    try:
        request = Request.read(event, namespace)
        return _answer(
            request, tables, store, left_ms, max_values=max_values, max_inline_bytes=max_inline_bytes
        )
    except RequestError as error:
        return {"error": str(error)}
    except MismatchError as error:
        return {"error": f"the condition cannot be evaluated: {error}"}


def _answer(
    request: Request, tables: Tables, store: Store, left_ms: Left, *, max_values: int, max_inline_bytes: int
) -> dict[str, Any]:
    found = Found(request, tables)
    items = pages = 0
    token: dict[str, Any] | None = None
    keys = with_samples_between(request.start_us, request.end_us)
    for page in tables.telemetry.pages(request.topic, keys, after=request.token, scan=request.scan):
        pages += 1
        token = page.after
        # A page of a car that stands still may inflate beyond the memory, so a page may be split.
        for number, item in enumerate(page.items, 1):
            items += 1
            found.add(plain(item))
            if found.values > max_values and number < len(page.items):
                token = {name: item[name] for name in (TOPIC, BATCH)}
                break
        if token is not None and (left_ms() < MARGIN_MS or found.values > max_values):
            break
    samples = _packed(found)
    reply: dict[str, Any] = {
        "codec": PLAIN_CODEC,
        "n": len(found.times_us),
        "fields": list(found.there),
        "items": items,
        "pages": pages,
        "refused": found.refused,
        "reason": found.reason,
        "absent": {name: n for name, n in found.absent.items() if request.needs(name)},
        "token": token,
    }
    if len(samples) * 4 // 3 <= max_inline_bytes:
        return {**reply, "samples": base64.b64encode(samples).decode()}
    return {**reply, "url": store(samples)}


def _packed(found: Found) -> bytes:
    """Times and columns, encoded like a batch; the first time is in ``dt``."""
    times = found.times_us
    dt = times[:1] + [b - a for a, b in pairwise(times)]
    text = json.dumps({"dt": dt, "fields": found.columns}, separators=(",", ":"))
    return zlib.compress(text.encode(), 1)


@cache
def _tables() -> Tables:
    return Tables(
        boto3.client("dynamodb"),
        telemetry=os.environ["TELEMETRY_TABLE"],
        summary="",  # it may not read this table
        robots=os.environ["ROBOTS_TABLE"],
    )


@cache
def _s3() -> Any:
    # As in functions/upload.py: the global host redirects, which invalidates a signature.
    config = Config(signature_version="s3v4", s3={"addressing_style": "virtual"})
    return boto3.client("s3", config=config)


def _store(samples: bytes) -> str:
    place = {"Bucket": os.environ["FILES_BUCKET"], "Key": f"{RESULTS_PREFIX}{uuid.uuid4().hex}.json.zlib"}
    _s3().put_object(**place, Body=samples, ContentType="application/zlib")
    url: str = _s3().generate_presigned_url("get_object", Params=place, ExpiresIn=_URL_S)
    return url


def handler(event: dict[str, Any], context: Any) -> dict[str, Any]:
    """Entry point of an invocation by the operator."""
    return answer(
        event,
        _tables(),
        _store,
        context.get_remaining_time_in_millis,
        namespace=os.environ["NAMESPACE"],
    )
