"""The command `iort`: its verbs are loaded when used, and wrong use has a status of its own."""

from __future__ import annotations

import io
import json
import subprocess
import sys

import pytest
import typer

from iort_station.cli import options, verbs
from iort_station.cli.main import app, main
from iort_station.cli.verbs import VERBS, Verb
from iort_station.errors import UsageError
from testkit.waiting import GUARD_S

# Each takes longer to import than `iort --help` may take.
HEAVY = {
    "boto3",
    "botocore.session",
    "matplotlib",
    "numpy",
    "pandas",
    "pubnub",
    "pyarrow",
    "pydantic",
    "rich",
}
PROGRAM = """
import json, sys
from iort_station.cli.main import main
sys.argv = ["iort", *sys.argv[1:]]
try:
    main()
finally:
    print(json.dumps(sorted(sys.modules)), file=sys.stderr)
"""


def loaded(*arguments):
    """The modules that a command has imported at its end."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        capture_output=True,
        text=True,
        timeout=GUARD_S,
        check=True,
    )
    return set(json.loads(done.stderr.splitlines()[-1]))


def test_help_imports_no_verb_and_nothing_heavy():
    found = loaded("--help")
    assert not found & HEAVY
    assert not [name for name in found if name.startswith(f"{verbs.__name__}.")]


def test_a_verb_loads_no_client_before_it_calls_the_cloud():
    assert not loaded("files", "get", "--help") & {"boto3", "botocore.session", "numpy", "pubnub"}


def test_no_verb_that_reads_samples_loads_numpy_for_tab():
    """TAB after a verb imports the verb, for its options."""
    program = """
import sys
from iort_station.cli.verbs import VERBS, Verb
for name in ("audit", "export", "laps", "plot", "query", "runs", "streams"):
    Verb(name).load()
print(*sorted(sys.modules))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=GUARD_S, check=True
    )
    assert not set(done.stdout.split()) & {"boto3", "botocore.session", "numpy", "pyarrow"}


@pytest.mark.parametrize("name", VERBS)
def test_each_verb_of_the_list_is_in_its_module_and_has_a_line_of_help(name):
    _, summary = VERBS[name]
    assert Verb(name).load().name == name
    assert len(f"  replay-errors  {summary}") <= 80
    assert summary.endswith(".")


@pytest.fixture
def _files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("ride.csv", "ride.mcap", "ride.png", "claim.yaml"):
        (tmp_path / name).touch()


@pytest.mark.usefixtures("_files")
@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["query", "car", "vesc", "--last", "soon"], 2, "duration must be"),
        (["query", "car", "vesc", "--last", "1m", "--to", "now"], 2, "give --last, or --from and --to"),
        (["plot", "car", "vesc", "--out", "speed.gif"], 2, "must end in .pdf, .png, .svg"),
        (["--local", "--embedded", "nowhere.json", "robots", "list"], 1, "no embedded cloud is running"),
        (["querry"], 2, "Did you mean 'query'?"),
        (["query", "car", "vesc", "--out", "ride.csv"], 1, "ride.csv exists: give another --out"),
        (["export", "car", "vesc", "--out", "ride.mcap"], 1, "ride.mcap exists: give another --out"),
        (["export", "car", "--out", "ride.db3"], 2, "must end in .bag or .mcap, and a folder in nothing"),
        (["export", "car", "--ros2", "--out", "a.bag"], 2, "--ros2 needs an .mcap or a folder"),
        (["export", "car", "--fps", "20", "--out", "a"], 2, "--fps and --task need --format lerobot"),
        (["export", "car", "--format", "lerobot", "--out", "a.mcap"], 2, "lerobot writes a folder"),
        (["plot", "car", "vesc", "--out", "ride.png"], 1, "ride.png exists: give another --out"),
        (["robots", "claim", "car", "--out", "."], 1, "claim.yaml exists: give another --out"),
    ],
)
def test_wrong_use_ends_with_status_2(arguments, status, said, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["iort", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == status
    assert said in capsys.readouterr().err


def every_command(commands):
    for command in commands:
        yield from every_command(command.commands.values()) if hasattr(command, "commands") else [command]


def test_every_command_has_json_and_shows_no_flag_as_a_boolean():
    verbs = typer.main.get_command(app).commands.values()
    for command in every_command([verb.load() for verb in verbs]):
        with typer.Context(command, info_name=command.name) as context:
            assert "<bool>" not in context.get_help()
            # One takes the keys of a terminal, and one speaks JSON alone.
            if command.name not in {"drive", "mcp"}:
                assert "--json" in context.get_help(), command.name


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_who_is_asked_can_agree_or_not(monkeypatch):
    options.agreed("Delete it?", yes=True)
    monkeypatch.setattr(sys, "stdin", Terminal("y\n"))
    options.agreed("Delete it?", yes=False)
    monkeypatch.setattr(sys, "stdin", Terminal("n\n"))
    with pytest.raises(typer.Abort):
        options.agreed("Delete it?", yes=False)
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    with pytest.raises(UsageError, match=r"^Delete it\? Nobody can answer here: give --yes$"):
        options.agreed("Delete it?", yes=False)
