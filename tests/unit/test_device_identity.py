"""Provisioning: what is tried again, and with what."""

from __future__ import annotations

import pytest

from device.errors import IdentityError
from device.identity import register_again


class Cloud:
    """Refuses so often, then registers."""

    def __init__(self, *refusals: str) -> None:
        self._refusals = list(refusals)
        self.asked = 0
        self.waited: list[float] = []

    def register(self) -> str:
        self.asked += 1
        if self._refusals:
            raise IdentityError(self._refusals.pop(0))
        return "car"


@pytest.mark.parametrize("refusals", [(), ("too late",), ("too late", "no answer")])
def test_a_registration_that_failed_is_tried_again_as_it_was(refusals: tuple[str, ...]) -> None:
    cloud = Cloud(*refusals)
    assert register_again(cloud.register, wait=cloud.waited.append) == "car"
    assert cloud.asked == len(refusals) + 1
    assert cloud.waited == [1.0, 4.0][: len(refusals)]


def test_what_is_refused_for_good_is_said_as_it_was_said_first() -> None:
    cloud = Cloud("not expected", "token is used up", "token is used up", "never asked")
    with pytest.raises(IdentityError, match=r"^not expected$"):
        register_again(cloud.register, wait=cloud.waited.append)
    assert (cloud.asked, cloud.waited) == (3, [1.0, 4.0])
