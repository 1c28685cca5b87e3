"""The structure of a message of which only the JSON is known."""

from __future__ import annotations

from typing import Any

import pytest

from iort_agent.ros1.json_message import Writer
from iort_agent.sources.rosbridge.inferred import infer
from iort_contract.limits import MessageError
from iort_contract.ros1.decode import Decoder


def sample(message: dict[str, Any]) -> dict[str, Any]:
    definition, normal, _ = infer(message)
    return Decoder(definition).decode(Writer(definition).write(normal))


@pytest.mark.parametrize(
    ("elements", "expected"),
    [
        # As in diagnostic_msgs/DiagnosticArray and visualization_msgs/MarkerArray.
        ([{"values": []}, {"values": [{"key": "k"}]}], {"a.1.values.0.key": "k"}),
        ([{"values": []}, {"values": ["text"]}], {"a.1.values.0": "text"}),
        ([{"x": 1}, {"x": 1.5}], {"a.0.x": 1.0, "a.1.x": 1.5}),
        ([{"x": [1]}, {"x": [1.5]}], {"a.0.x.0": 1.0, "a.1.x.0": 1.5}),
        ([{"x": 1}, {"x": 2**63}], {"a.0.x": 1, "a.1.x": 2**63}),
        ([1, 2**63], {"a.0": 1, "a.1": 2**63}),
    ],
)
def test_the_first_element_does_not_speak_for_all(elements: list[Any], expected: dict[str, Any]) -> None:
    assert sample({"a": elements}) == expected


@pytest.mark.parametrize("elements", [[{"x": 1}, {"y": 1}], [[1], [2]], [1, True], ["x", 1], [1, {"x": 1}]])
def test_what_no_array_of_ros_holds_is_refused(elements: list[Any]) -> None:
    with pytest.raises(MessageError):
        sample({"a": elements})
