"""The page's generated code has the contract's fields and formulas. docs/test_pages.py keeps it current."""

from __future__ import annotations

import json
import re

from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.entries import Derived
from iort_contract.catalog.vesc import FAULTS, VESC
from scripts.docs_parts import PAGE
from scripts.page_contract import formula


def test_the_page_has_each_field_with_its_unit() -> None:
    source = PAGE.read_text()
    (table,) = re.findall(r"FIELD_TABLE: FieldTable = (\{.*?^\});", source, re.DOTALL | re.MULTILINE)
    fields, faults = json.loads(table)["fields"], json.loads(table)["faults"]
    assert fields.keys() >= {field.name for field in VESC.fields} | DERIVED.keys()
    assert fields["charge_drawn"]["ros2_unit"] == "Ah"
    assert faults["5"] == FAULTS[5]


def test_a_formulas_text_calculates_the_same_value() -> None:
    values = {"speed": 9300.0, "speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 3.0}
    values |= {"voltage_input": 12.0, "current_input": -3.0}
    for entry in DERIVED.values():
        arguments = {name: values[name] for name in entry.arguments}
        assert eval(formula(entry), {}, arguments) == entry.formula(**arguments)  # our own entries


def test_a_formulas_text_has_only_necessary_brackets() -> None:
    entry = Derived("x", "", "", lambda a, b, c: 2 * (a - (b - c)) / (a / b) + a * b * c - (1 - a))
    text = formula(entry)
    assert text == "2 * (a - (b - c)) / (a / b) + a * b * c - (1 - a)"
