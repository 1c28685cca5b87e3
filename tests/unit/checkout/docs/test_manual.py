"""The help of every verb: plain, with examples that are right. tests/local runs the examples."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.manual import COMMANDS, examples, parse


def test_the_completion_knows_the_commands():
    iort = Path(sys.executable).parent / "iort"
    asked = {"_IORT_COMPLETE": "complete_bash", "COMP_WORDS": "iort qu", "COMP_CWORD": "1"}
    done = subprocess.run([iort], env=asked, capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout.split() == ["query"], done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_explains_each_option_and_has_an_example(name):
    command = COMMANDS[name]
    assert command.help
    unexplained = [parameter.name for parameter in command.params if not getattr(parameter, "help", None)]
    assert unexplained == []
    assert examples(name)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_examples_of_a_command_call_it(name):
    assert {parse(example) for example in examples(name)} == {name}
