"""The generated parts of the documentation say what the code says."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from scripts import docs_parts


def test_every_part_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert docs_parts.main(check=True) == 0, "".join(capsys.readouterr())


def test_a_part_changed_by_hand_is_generated_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "fields.md"
    shutil.copy(docs_parts.ROOT / "docs/reference/fields.md", page)
    text = page.read_text()
    page.write_text(text.replace("| `speed` | erpm |", "| `speed` | km/h |"))
    assert page.read_text() != text
    assert docs_parts.main(page, check=True) != 0
    assert "make docs-parts" in "".join(capsys.readouterr())
    assert docs_parts.main(page) == 0
    assert page.read_text() == text
