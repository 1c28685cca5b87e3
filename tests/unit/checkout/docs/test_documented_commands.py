"""The command lines take every command that README and docs/ show."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator

import pytest
import typer
from typer._click.exceptions import BadOptionUsage, MissingParameter, NoArgsIsHelpError, UsageError

from iort_agent import cli as agent
from iort_station.cli.main import app
from scripts.docs_parts import ROOT

# Not the page that adds a verb.
PAGES = [ROOT / "README.md", *sorted(page for page in ROOT.glob("docs/*/*.md") if page.name != "extend.md")]
COMMAND = re.compile(r"^(?:sudo -u iort )?(?:/opt/iort/bin/)?((?:iort|iort-agent) [a-z-].*)$", re.MULTILINE)


def in_blocks(text: str) -> Iterator[str]:
    """The commands of a page's shell blocks, fenced or indented."""
    yield from re.findall(r"^ {4,7}((?:iort|iort-agent) [a-z-].*)$", text, re.MULTILINE)
    for block in re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        yield from COMMAND.findall(block.replace("\\\n", " "))


def in_text(text: str) -> Iterator[str]:
    """The commands of a page's text, which leaves arguments out."""
    for code in re.findall(r"(?<!`)`(iort [^`]+)`", text):
        if "..." not in code and "completion" not in code:  # which is about the shell
            yield " ".join(code.split())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_command_line_takes_every_command_of_a_page(page):
    text = page.read_text()
    assert [found for line in in_blocks(text) if (found := problem(line))] == []
    wrong = [found for line in in_text(text) if (found := problem(line))]
    incomplete = (MissingParameter, BadOptionUsage, NoArgsIsHelpError)
    assert [found for found in wrong if not isinstance(found, incomplete)] == []


def problem(line):
    """What is wrong with a line, if anything is."""
    try:
        parse(line)
    except typer.Exit:  # --help, --version
        return None
    except (UsageError, SystemExit) as error:
        return error
    return None


def parse(line):
    """Parse a line as its command does, and run nothing."""
    program, *arguments = shlex.split(line, comments=True)
    if program == "iort-agent":
        if arguments != ["--version"]:
            agent._parse(arguments)
        return
    command, context = typer.main.get_command(app), None
    while True:
        context = command.make_context(command.name, list(arguments), parent=context)
        rest = [*context._protected_args, *context.args]
        if not hasattr(command, "resolve_command") or not rest:
            return
        _, command, arguments = command.resolve_command(context, rest)


@pytest.mark.parametrize(
    "wrong", ["iort query car7 vesc --sins 10m", "iort qery car7", "iort-agent chek --config c"]
)
def test_a_wrong_command_is_found(wrong):
    (line,) = in_blocks(f"```sh\n{wrong}  # wrong\n```\n")
    assert problem(line) is not None
