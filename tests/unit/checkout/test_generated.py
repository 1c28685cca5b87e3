"""What is generated from the catalogue is current: `python scripts/generate.py` writes it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.vesc import FAULTS, VESC
from scripts.generate import DOCUMENTS, PAGE, filled, formula, page_source


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.name)
def test_the_documents_tables_are_the_catalogues(document: Path) -> None:
    text = document.read_text()
    assert filled(text) == text
    assert "<!-- /" in text


def test_the_pages_constants_and_types_are_the_contracts() -> None:
    source = PAGE.read_text()
    assert source == page_source()
    (table,) = re.findall(r"FIELD_TABLE: FieldTable = (\{.*?^\});", source, re.DOTALL | re.MULTILINE)
    fields, faults = json.loads(table)["fields"], json.loads(table)["faults"]
    assert fields.keys() >= {field.name for field in VESC.fields} | DERIVED.keys()
    assert fields["charge_drawn"]["ros2_unit"] == "Ah"
    assert faults["5"] == FAULTS[5]


def test_a_formula_is_told_as_it_calculates() -> None:
    values = {"speed": 9300.0, "speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 3.0}
    values |= {"voltage_input": 12.0, "current_input": -3.0}
    for entry in DERIVED.values():
        arguments = {name: values[name] for name in entry.arguments}
        assert eval(formula(entry), {}, arguments) == entry.formula(**arguments)  # our own entries
