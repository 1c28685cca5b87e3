from __future__ import annotations

import pytest

from tests.conftest import Synthesized
from tests.stacks.templates import Reader


@pytest.fixture(scope="session")
def reader(synthesized: Synthesized) -> Reader:
    return Reader(synthesized)
