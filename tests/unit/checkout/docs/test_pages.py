"""README and docs/ name what exists: links, commands and decisions."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer._click.exceptions import BadOptionUsage, MissingParameter, NoArgsIsHelpError, UsageError

from iort_agent import cli as agent
from iort_agent.config import load_config
from iort_station.cli.main import app
from scripts import docs_parts
from scripts.docs_parts import ROOT
from testkit.waiting import GUARD_S
from tests.manual import COMMANDS, examples
from tests.manual import parse as verb

DOCS = sorted(ROOT.glob("docs/**/*.md"))
# A decision may name a file of its time, and the changelog one that was removed.
CURRENT = [page for page in DOCS if "decisions" not in page.parts]
PAGES = [*CURRENT, *ROOT.glob("*/README.md"), *(p for p in ROOT.glob("*.md") if p.name != "CHANGELOG.md")]
COMMAND = re.compile(r"^(?:sudo -u iort )?(?:/opt/iort/bin/)?((?:iort|iort-agent) [a-z-].*)$", re.MULTILINE)


def each(pages: list[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("page", pages, ids=lambda page: str(page.relative_to(ROOT)))


def test_every_part_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert docs_parts.main(check=True) == 0, "".join(capsys.readouterr())


def test_a_part_changed_by_hand_is_generated_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "fields.md"
    shutil.copy(ROOT / "docs/reference/fields.md", page)
    text = page.read_text()
    page.write_text(text.replace("| `speed` | erpm |", "| `speed` | km/h |"))
    assert docs_parts.main(page, check=True) != 0
    assert "make docs-parts" in "".join(capsys.readouterr())
    assert docs_parts.main(page) == 0
    assert page.read_text() == text


@each([*DOCS, *ROOT.glob("*.md")])
def test_every_file_and_heading_that_a_page_links_to_exists(page: Path) -> None:
    for path, anchor in re.findall(r"\]\(([^)#: ]*)(?:#([^)]+))?\)", page.read_text(encoding="utf-8")):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target.read_text(encoding="utf-8")), f"{path}#{anchor}"


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_make_target_that_is_named_exists() -> None:
    text = "\n".join(page.read_text() for page in PAGES)
    targets = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    shell = "\n".join(re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    named = {
        *re.findall(r"`make ([a-z0-9-]+)", text),
        *re.findall(r"^make ([a-z0-9-]+)", shell, re.MULTILINE),
    }
    assert len(named) > 20
    assert named <= targets


def test_every_decision_has_its_own_number() -> None:
    records = sorted((ROOT / "docs" / "decisions").glob("*/*.md"), key=lambda path: path.name)
    numbers = [int(path.name[:4]) for path in records]
    assert numbers == sorted(set(numbers))
    for path, number in zip(records, numbers, strict=True):
        assert path.read_text().startswith(f"# {number}. "), path.name


@pytest.mark.parametrize("page", ["reference/car-yaml.md", "how-to/ros2.md"])
def test_the_agent_reads_the_example_of_car_yaml(tmp_path: Path, page: str) -> None:
    text = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)[0]
    if "robot:" not in text:
        text += "robot: car7\nendpoint: localhost\ncertificate: certificate.pem\nprivate_key: private.key\n"
    (tmp_path / "car.yaml").write_text(text)
    for name in ("certificate.pem", "private.key"):
        (tmp_path / name).touch()
    assert load_config(tmp_path / "car.yaml").robot == "car7"


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


# Not the page that adds a verb.
@each([ROOT / "README.md", *(page for page in CURRENT if page.name != "extend.md")])
def test_the_command_line_takes_every_command_of_a_page(page: Path) -> None:
    text = page.read_text()
    assert [found for line in in_blocks(text) if (found := problem(line))] == []
    wrong = [found for line in in_text(text) if (found := problem(line))]
    incomplete = (MissingParameter, BadOptionUsage, NoArgsIsHelpError)
    assert [found for found in wrong if not isinstance(found, incomplete)] == []


def problem(line: str) -> BaseException | None:
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
def test_a_wrong_command_is_found(wrong: str) -> None:
    (line,) = in_blocks(f"```sh\n{wrong}  # wrong\n```\n")
    assert problem(line) is not None


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_explains_each_option_and_has_examples_that_call_it(name: str) -> None:
    """tests/local runs the examples."""
    command = COMMANDS[name]
    assert command.help
    unexplained = [parameter.name for parameter in command.params if not getattr(parameter, "help", None)]
    assert unexplained == []
    assert {verb(example) for example in examples(name)} == {name}


def test_the_completion_knows_the_commands() -> None:
    iort = Path(sys.executable).parent / "iort"
    words = {"_IORT_COMPLETE": "complete_bash", "COMP_WORDS": "iort qu", "COMP_CWORD": "1"}
    done = subprocess.run([iort], env=words, capture_output=True, text=True, check=False, timeout=GUARD_S)
    assert done.stdout.split() == ["query"], done.stderr
