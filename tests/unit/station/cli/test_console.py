"""A robot's texts reach neither the operator's terminal nor a spreadsheet as commands."""

from __future__ import annotations

import ast
import io
import json
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text

import iort_station
from iort_station.cli.console import Console
from iort_station.texts import visible

# Write the clipboard; the same with C1; move the cursor and ring the bell; reverse a line.
HOSTILE = ["\x1b]52;c;cm0gLXJmIH4=\x07", "\x9d52;c;YQ==\x9c", "\x1b[2J\x7f\x08", "a\u202eb\u2066", "\ud800"]


@pytest.mark.parametrize("text", HOSTILE)
def test_control_characters_are_shown_as_their_codes(text):
    shown = visible(text)
    assert shown.isprintable()
    assert json.loads(f'"{shown}"') == text


def test_printable_text_stays_unchanged():
    text = "Käfer\t1\n日本 🚗 [bold] :car: \\x1b"
    assert visible(text) == text


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize("text", HOSTILE)
def test_the_console_prints_no_control_characters(terminal, text):
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=200, color_system=None)
    table = Table(title=text)
    table.add_column(text)
    table.add_row(text)
    table.add_row(Text(text))
    for one in (text, Text(text), Text.assemble((text, "bold")), table):
        console.print(one)
        console.print(one, soft_wrap=True)
    console.print_json(json.dumps([text], ensure_ascii=False))
    said = file.getvalue()
    # `Text` itself removes the bell and the backspace.
    assert said.count(visible(Text(text).plain)) == 15
    assert not [one for one in said if not one.isprintable() and one != "\n"]


def test_a_text_among_others_begins_no_line_of_its_own():
    file = io.StringIO()
    console = Console(file=file, width=200)
    # A setting's value as a robot may report it.
    console.print("fields.vesc=speed\ncar1 is stopped\r\n\tall is well", soft_wrap=True)
    console.print("two\nlines", lines=True)
    assert file.getvalue().splitlines() == [
        r"fields.vesc=speed\ncar1 is stopped\u000d\n\tall is well", "two", "lines",
    ]  # fmt: skip


def test_markup_and_emoji_codes_are_printed_literally():
    file = io.StringIO()
    console, table = Console(file=file, width=200), Table("[link=https://example.org]here[/link]")
    table.add_row("[/]")
    console.print("[/bold] :car:")
    console.print(table)
    for text in ("[/bold] :car:", "[link=https://example.org]here[/link]", "[/]"):
        assert text in file.getvalue()


def test_every_command_prints_by_the_console():
    """The other prints are listed: the version, a line of JSON, and the escaped error."""
    folder, printing = Path(iort_station.__file__).parent, set()
    for path in folder.rglob("*.py"):
        name, tree = str(path.relative_to(folder)), ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module == "rich.console":
                assert "Console" not in {alias.name for alias in node.names}, name
            if isinstance(node, ast.Call) and ast.unparse(node.func) in {"print", "typer.echo", "click.echo"}:
                printing.add((name, ast.unparse(node.args[0])))
    assert printing == {
        ("cli/main.py", "f\"iort {version('iort-station')}\""),
        ("cli/words.py", "visible(f'iort: {text}')"),
        # Made visible a cell at a time.
        ("cli/tables.py", "stamp.ljust(len(_TIME_WIDE))"),
        ("cli/verbs/page/watch.py", "json.dumps({**line, 'sample': live.sample})"),
    }
