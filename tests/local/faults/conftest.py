"""The way between a car and its cloud, which a test makes worse."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from local.cloud import EmbeddedCloud
from testkit.proxy import Proxy


@pytest.fixture
def proxy(embedded: EmbeddedCloud) -> Iterator[Proxy]:
    with Proxy("127.0.0.1", embedded.cloud.mqtt_port) as proxy:
        yield proxy
