"""A mail's subject is one that SNS takes."""

from __future__ import annotations

import pytest

from functions.shared.clients import SUBJECT_CHARACTERS, subject_line


@pytest.mark.parametrize(
    ("text", "subject"),
    [
        ("iort: car7, fault 5", "iort: car7, fault 5"),
        ("a" * 99, "a" * 99),
        # "Less than 100 characters long".
        ("a" * 100, "a" * 96 + "..."),
        ("two\nlines\x00", "two lines "),
    ],
)
def test_a_subject_is_one_short_line(text, subject):
    assert subject_line(text) == subject
    assert len(subject_line(text)) <= SUBJECT_CHARACTERS < 100
