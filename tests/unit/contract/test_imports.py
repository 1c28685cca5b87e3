"""Every module of the contract can be imported, on the robot's oldest Python too (`make test-oldest`)."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import iort_contract

MODULES = [one.name for one in pkgutil.walk_packages(iort_contract.__path__, "iort_contract.")]


@pytest.mark.parametrize("name", MODULES)
def test_the_module_can_be_imported(name: str) -> None:
    assert importlib.import_module(name).__doc__
