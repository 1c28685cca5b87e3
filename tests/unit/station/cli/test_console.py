"""A robot's texts reach neither the operator's terminal nor a spreadsheet as commands."""

from __future__ import annotations

import csv
import io
import json
from types import SimpleNamespace

import pytest
from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from typer.testing import CliRunner

from iort_contract.messages.batch import Batch
from iort_station.cli.console import Console, Lines
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions, say
from iort_station.errors import StationError
from iort_station.output import visible
from tests.unit.station.data.test_queries import FakeCloud, cloud_of

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


# As a robot may report it, to look like a line of ours.
FORGED = "speed\niort: all is well\r\n\tcar1 is stopped"


def no_forged_line(said: str) -> bool:
    return not [line for line in said.splitlines() if line.strip().startswith(("iort: all", "car1 is"))]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_robots_text_begins_no_line_of_its_own_wherever_it_is_printed(terminal):
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=200, color_system=None)
    table = Table(title=FORGED, caption=FORGED)
    table.add_column(FORGED)
    table.add_column(Text(FORGED), no_wrap=True, overflow="fold")
    table.add_row(FORGED, Text.assemble((FORGED, "red")))
    texts = (FORGED, Text(FORGED), Text.assemble("said: ", (FORGED, "bold")))
    for one in (*texts, table, Padding(table, 1), *map(Group, texts)):
        console.print(one)
        console.print(one, soft_wrap=True)
        console.print(one, style="red")
    said = file.getvalue()
    assert no_forged_line(said)
    assert said.count(r"speed\niort: all") == 3 * (6 + 2 * 6)
    # Ours has lines.
    console.print(Lines("two\nlines"), end="")
    assert file.getvalue().endswith("two\nlines\n")


def test_the_styles_of_a_text_in_several_lines_stay():
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=200, color_system="standard")
    console.print(Text.assemble("said: ", ("a\nb", "bold"), " end"))
    assert file.getvalue() == "said: \x1b[1ma\x1b[0m\\n\x1b[1mb\x1b[0m end\n"


def test_words_and_errors_are_one_line_unless_they_are_given_as_several(capsys):
    say(FORGED)
    say("first", FORGED)
    said = capsys.readouterr().err
    assert no_forged_line(said)
    assert len(said.splitlines()) == 3
    assert str(StationError("a", "b")) == "a\nb"


LETTER = {
    **{name: {"S": FORGED} for name in ("source", "topic", "reason", "robot")},
    "id": {"S": "e1"},
    "last_ms": {"N": "1"},
    "payload": {"B": FORGED.replace("\r", "").encode()},
}


class Robot(FakeCloud):
    """A robot whose every text is forged, as the verbs ask a cloud about it."""

    exceptions = SimpleNamespace(ResourceNotFoundException=KeyError)

    def client(self, service):
        return self if service in {"iot", "iot-data", "sqs"} or self.asks_quarantine else self.table

    asks_quarantine = False

    def output(self, noun, name):
        self.asks_quarantine = name == "QuarantineTable"
        return name if noun == "quarantine" or self.asks_quarantine else super().output(noun, name)

    def get_paginator(self, _operation):
        return SimpleNamespace(paginate=lambda **_: [{"Items": [LETTER]}])

    def get_item(self, **_):
        return {"Item": LETTER}

    def get_queue_attributes(self, **_):
        names = ("ApproximateNumberOfMessages", "ApproximateNumberOfMessagesNotVisible")
        return {"Attributes": dict.fromkeys(names, "0")}

    def describe_thing(self, **_):
        return {"ResponseMetadata": {"HTTPHeaders": {}}}

    def get_thing_shadow(self, **_):
        rejected = {"log_level": {"value": FORGED, "reason": FORGED}}
        reported = {"log_level": FORGED, "fields": {"vesc": [FORGED]}, "rejected": rejected}
        state = {"state": {"desired": {"log_level": FORGED}, "reported": reported}}
        return {"payload": io.BytesIO(json.dumps(state).encode())}


@pytest.mark.parametrize(
    ("arguments", "times"),
    [
        (["config", "car"], 3),
        (["errors"], 4),
        (["errors", "e1"], 5),
        (["query", "car", "vesc", "--last", "all"], 3),
        (["query", "car", "vesc", "--last", "all", "--format", "csv"], None),
    ],
)
def test_no_verb_prints_a_line_of_a_robots(monkeypatch, arguments, times):
    batch = Batch("0badcafe", 0, [1_700_000_000_000_000 + i for i in range(3)], {"mode": [FORGED] * 3})
    cloud = Robot(cloud_of(batch).table)
    monkeypatch.setattr(CloudOptions, "cloud", lambda _: cloud)
    done = CliRunner().invoke(app, arguments)
    assert not isinstance(done.exception, (TypeError, KeyError, AttributeError)), done.exception
    said = done.output + str(done.exception or "")
    if times is None:
        # A file's value is the robot's own; its lines are within the quotes.
        assert next(csv.DictReader(io.StringIO(done.stdout)))["mode"].startswith("speed")
        return
    assert no_forged_line(said), said
    assert said.count(r"speed\niort: all is well") == times, said


def test_markup_and_emoji_codes_are_printed_literally():
    file = io.StringIO()
    console, table = Console(file=file, width=200), Table("[link=https://example.org]here[/link]")
    table.add_row("[/]")
    console.print("[/bold] :car:")
    console.print(table)
    for text in ("[/bold] :car:", "[link=https://example.org]here[/link]", "[/]"):
        assert text in file.getvalue()
