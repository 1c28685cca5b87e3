"""Query: filters a range of samples in the cloud, so that only matching ones leave AWS.

The operator's `iort query --on lambda` invokes it. The answer is encoded like a batch; a large answer goes
through the files' bucket by a pre-signed address. An invocation stops before its time or memory runs out, and
returns a token to continue.
"""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.tables import Tables
from iort_contract import expression
from iort_contract.catalog.derived import DERIVED, derive
from iort_contract.catalog.environments import QueryEnvironment
from iort_contract.cloud import RESULTS_PREFIX
from iort_contract.dynamodb import plain, quick, with_samples_between
from iort_contract.expression import ExpressionError, MismatchError, Node
from iort_contract.limits import ContractError, Value
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.questions import (
    QueryAnswer,
    QueryRequest,
    decode_query_request,
    encode_query_answer,
    packed_samples,
)
from iort_contract.statistics import without_absent
from iort_contract.tables import BATCH, TOPIC
from iort_contract.topics import RECORD, build_topic

# Lambda's synchronous answer holds 6 MB; the envelope around the samples takes some hundred bytes.
MAX_INLINE_BYTES = 5_500_000
# Python takes some 30 bytes a value, and encoding as much again.
MAX_VALUES = 6_000_000
# The last page is requested with at least this much time left: encoding and storing take no longer.
MARGIN_MS = 8_000
_URL_S = 900

Store = Callable[[bytes], str]
Left = Callable[[], int]


@dataclass(frozen=True)
class Query:
    """A request with its topic and its parsed condition."""

    request: QueryRequest
    topic: str
    condition: Node | None

    @classmethod
    def read(cls, event: Mapping[str, Any], namespace: str) -> Query:
        """Read a query from an event; raises `ContractError` or `ExpressionError`."""
        request = decode_query_request(event)
        return cls(
            request,
            build_topic(RECORD, request.robot, request.stream, namespace),
            None if request.where is None else expression.parse(request.where),
        )

    @property
    def deciding(self) -> frozenset[str]:
        """The fields in the condition."""
        return frozenset() if self.condition is None else expression.names(self.condition)

    def needs(self, name: str) -> bool:
        """Whether the answer needs this stored field."""
        fields = self.request.fields
        return fields is None or name in fields or name in self.deciding


class Found:
    """The matching samples, as growing lists."""

    def __init__(self, query: Query, tables: Tables) -> None:
        self._query = query
        self._derived = sorted(query.deciding.union(query.request.fields or ()) & DERIVED.keys())
        self._vehicle = tables.vehicle(query.request.robot) if self._derived else None
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
        query, request = self._query, self._query.request
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
        if query.condition is not None:
            inside = {name: [columns[name][i] for i in chosen] for name in query.deciding & columns.keys()}
            holds = expression.holds(query.condition, inside, len(chosen))
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
        query = Query.read(event, namespace)
        found = _answer(
            query, tables, store, left_ms, max_values=max_values, max_inline_bytes=max_inline_bytes
        )
    except (ContractError, ExpressionError) as error:
        found = QueryAnswer(error=str(error))
    except MismatchError as error:
        found = QueryAnswer(error=f"the condition cannot be evaluated: {error}")
    return encode_query_answer(found)


def _answer(
    query: Query, tables: Tables, store: Store, left_ms: Left, *, max_values: int, max_inline_bytes: int
) -> QueryAnswer:
    found = Found(query, tables)
    items = pages = 0
    token: dict[str, Any] | None = None
    request = query.request
    keys = with_samples_between(request.start_us, request.end_us)
    for page in tables.telemetry.pages(query.topic, keys, after=request.token, scan=request.scan):
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
    samples = packed_samples(found.times_us, found.columns)
    inline = len(samples) * 4 // 3 <= max_inline_bytes
    return QueryAnswer(
        n=len(found.times_us),
        fields=tuple(found.there),
        items=items,
        pages=pages,
        refused=found.refused,
        reason=found.reason,
        absent={name: n for name, n in found.absent.items() if query.needs(name)},
        token=token,
        samples=samples if inline else None,
        url=None if inline else store(samples),
    )


@cache
def _tables() -> Tables:
    given = variables(QueryEnvironment)
    # It may not read the summary table.
    return Tables(
        quick(clients.dynamodb()), telemetry=given.telemetry_table, summary="", robots=given.robots_table
    )


def _store(samples: bytes) -> str:
    bucket, key = variables(QueryEnvironment).files_bucket, f"{RESULTS_PREFIX}{uuid.uuid4().hex}.json.zlib"
    clients.s3().put_object(Bucket=bucket, Key=key, Body=samples, ContentType="application/zlib")
    place = {"Bucket": bucket, "Key": key}
    return clients.s3().generate_presigned_url("get_object", Params=place, ExpiresIn=_URL_S)


def handler(event: dict[str, Any], context: Any) -> dict[str, Any]:
    """Entry point of an invocation by the operator."""
    left_ms = context.get_remaining_time_in_millis
    return answer(event, _tables(), _store, left_ms, namespace=variables(QueryEnvironment).namespace)
