"""The command `iort-agent`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import re
import signal
import sys
import time
from pathlib import Path
from typing import Any, Callable, NoReturn, Sequence

from iort_agent.agent import Agent, agent_version, make_status
from iort_agent.common.logs import Troubles, neutral, set_up
from iort_agent.common.schema import did_you_mean
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config, load_config, without_sources
from iort_agent.errors import AgentError, ConfigError
from iort_agent.ros.arguments import CONFIG, LOG_LEVEL, is_remapping, split
from iort_agent.ros.ros1_node import DEFAULT_NODE
from iort_agent.runtime import Runtime, make_uplink
from iort_agent.spool.sqlite import make_spool
from iort_agent.status import SOCKET, StatusServer, ask, fetch
from iort_agent.status import render as render_status
from iort_contract.messages.shadow import LOG_LEVELS

_log = logging.getLogger("iort-agent")

# A terminal signals the whole process group, and a supervisor passes it on: the two count as one.
_SAME_SIGNAL_S = 1.0
_NO_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit status: 0 good, 1 something failed or was lost, 2 wrong use."""
    # Only the user may read what a command writes, until the user allows more.
    before = os.umask(0o077)
    options = argparse.Namespace(command=None)
    try:
        options = _parse(list(sys.argv[1:] if arguments is None else arguments))
        status: int = options.command(options)
        sys.stdout.flush()
    except ConfigError as error:
        print(f"iort-agent: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        if options.command is run:
            raise
        # The reader of our output has closed it. Otherwise Python would complain when it flushes at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except AgentError as error:
        if options.command is not run:
            print(f"iort-agent: {neutral(str(error))}", file=sys.stderr)
        else:
            _log.error("%s", error)
        return 1
    else:
        return status
    finally:
        os.umask(before)


class _Parser(argparse.ArgumentParser):
    """Names the nearest choice for a wrong one."""

    def error(self, message: str) -> NoReturn:
        wrong = _NO_CHOICE.search(message)
        hint = did_you_mean(wrong.group(1), re.findall(r"[\w-]+", wrong.group(2))) if wrong else ""
        super().error(message + hint)


def command_line() -> argparse.ArgumentParser:
    """The commands and their options."""
    parser = _Parser(
        prog="iort-agent",
        description="Sends a robot's data to AWS IoT: every sample recorded, the newest one live. "
        "Without COMMAND it runs: `iort-agent --config FILE`.",
    )
    parser.add_argument("--version", action="version", version=f"iort-agent {agent_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(name: str, function: Callable[[argparse.Namespace], int], text: str) -> Any:
        added = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        added.set_defaults(command=function)
        added.add_argument("--config", type=Path, required=True, metavar="FILE", help="the agent's YAML file")
        return added

    running = command("run", run, "run the agent until its sources end or a signal comes")
    running.add_argument("--check-config", action="store_true", help="check the file and exit")
    running.add_argument(
        "--report", type=Path, metavar="FILE", help="write the last status as JSON at the end"
    )
    running.add_argument(
        "--drain-s",
        type=_seconds,
        metavar="S",
        help="how long to wait at the end until everything is delivered "
        "(default: as long as it takes, or 10 after a signal)",
    )
    running.add_argument("--log-level", choices=LOG_LEVELS, help="instead of the file's log_level")
    flushing = command("flush", flush, "deliver what the queue and the recorder hold, and record nothing")
    flushing.add_argument("--drain-s", type=_seconds, metavar="S", help="give up after this time")
    checking = command("check", check, "check everything that the file names, and say what to do")
    checking.add_argument("--json", action="store_true", help="as JSON")
    uploading = command("upload", upload, "upload files, and print their keys")
    uploading.add_argument("files", type=Path, nargs="+", metavar="FILE", help="a file to upload")
    uploading.add_argument("--json", action="store_true", help="as JSON")
    status = command("status", show_status, "show what the running agent does")
    status.add_argument("--json", action="store_true", help="as JSON")
    claiming = command("provision", provision, "exchange a claim for a certificate of the robot's own")
    claiming.add_argument("--robot", metavar="NAME", help="the robot's name, instead of the claim's")
    renewing = command("renew", renew, "replace the robot's key and certificate, with a new claim")
    renewing.add_argument("--claim", type=Path, required=True, metavar="FILE", help="the claim's YAML file")
    text = "look at the robot's ROS topics and VESCs, and write `sources` of car.yaml; overwrites nothing"
    starting = commands.add_parser("init", help=text, description=text[0].upper() + text[1:] + ".")
    starting.set_defaults(command=init)
    starting.add_argument(
        "--out",
        type=Path,
        default=Path("car.yaml"),
        metavar="FILE",
        help="the file to write (default: car.yaml); if it exists, FILE.new.yaml is, with its other sections",
    )
    starting.add_argument("--all", action="store_true", help="also what is left out otherwise")
    starting.add_argument(
        "--topic", nargs="+", default=[], metavar="NAME", help="these topics alone; /sensors/* is possible"
    )
    starting.add_argument(
        "--listen-s", type=_seconds, default=5.0, metavar="S", help="how long to listen (default: 5)"
    )
    return parser


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = command_line()
    if not arguments:
        parser.print_help(sys.stderr)
        raise SystemExit(2)
    first = arguments[0]
    ignored: list[str] = []
    if first not in ("-h", "--help", "--version") and (first.startswith("-") or is_remapping(first)):
        arguments = ["run", *arguments]
    if arguments[0] == "run":
        arguments, parameters, ignored = split(arguments, DEFAULT_NODE)
        # As options of the command line, which has the last word.
        given = [(name, parameters[name]) for name in (CONFIG, LOG_LEVEL) if parameters.get(name)]
        arguments[1:1] = [text for name, value in given for text in (f"--{name.replace('_', '-')}", value)]
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        names = [f"--{name}".replace("_", "-") for name in vars(options) if name != "command"]
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{did_you_mean(unknown[0], names)}")
    options.ignored = ignored
    return options


def _seconds(value: str) -> float:
    seconds = float(value)
    if not 0 <= seconds <= 86_400:
        raise argparse.ArgumentTypeError(f"must be 0 to 86400, got {value}")
    return seconds


def run(options: argparse.Namespace) -> int:
    """`iort-agent run`."""
    config = load_config(options.config)
    if options.check_config:
        print(f"{options.config}: good, robot {config.robot}, {len(config.sources)} source(s)")
        return 0
    if options.log_level is not None:
        config = dataclasses.replace(config, log_level=options.log_level)
    troubles = set_up(config.log_level)
    for argument in options.ignored:
        _log.warning("%s is ignored: %s has the agent's settings", argument, options.config)
    status, agent = _run(config, options, troubles)
    report = make_status(agent)
    if options.report is not None:
        options.report.write_text(json.dumps(dataclasses.asdict(report), indent=2) + "\n", encoding="utf-8")
    samples = sum(stream.samples for stream in report.streams.values())
    _log.info("ended: %d samples, %d live messages", samples, report.lanes.live.published)
    return status


def flush(options: argparse.Namespace) -> int:
    """`iort-agent flush`: status 1 if something is left."""
    config = load_config(options.config)
    status, _ = _run(without_sources(config), options, set_up(config.log_level))
    return status


def _run(config: Config, options: argparse.Namespace, troubles: Troubles) -> tuple[int, Agent]:
    clock = SystemClock()
    uplink = make_uplink(config, clock)
    spool = make_spool(config.queue, clock)
    try:
        agent = Agent(config, uplink=uplink, spool=spool, clock=clock, troubles=troubles)
        server = StatusServer(_socket(options, config), lambda: dataclasses.asdict(make_status(agent)))
        server.start()
        runtime = Runtime(agent)
        _end_on_signals(runtime)
        try:
            status = runtime.run(drain_s=options.drain_s)
        finally:
            server.stop()
    finally:
        spool.close()
    return status, agent


def check(options: argparse.Namespace) -> int:
    """`iort-agent check`: status 1 if something would not work."""
    from iort_agent.sources import FAIL  # noqa: PLC0415 - only this verb needs it
    from iort_agent.verbs.check import check as findings_of  # noqa: PLC0415 - as above
    from iort_agent.verbs.check import render  # noqa: PLC0415 - it loads the network's library

    config = load_config(options.config)
    findings = []
    for finding in findings_of(config, _socket(options, config)):
        findings.append(finding)
        if not options.json:
            print(render(finding), flush=True)
    if options.json:
        print(json.dumps([finding._asdict() for finding in findings], indent=2))
    return 1 if any(finding.level == FAIL for finding in findings) else 0


def show_status(options: argparse.Namespace) -> int:
    """`iort-agent status`."""
    path = _socket(options, load_config(options.config))
    print(json.dumps(fetch(path), indent=2) if options.json else render_status(ask(path)))
    return 0


def upload(options: argparse.Namespace) -> int:
    """`iort-agent upload`: status 1 if a file is not in the bucket now."""
    from iort_agent.verbs.upload import upload_files  # noqa: PLC0415 - as above

    config = load_config(options.config)
    results = upload_files(config, options.files, status_socket=_socket(options, config))
    failed = False
    rows = []
    for result in results:
        failed |= result.error is not None
        rows.append({**result._asdict(), "path": str(result.path)})
        if result.error is not None:
            print(f"iort-agent: {neutral(result.error)}", file=sys.stderr)
        elif not options.json:
            print(neutral(str(result.key)), flush=True)
    if options.json:
        print(json.dumps(rows, indent=2))
    return 1 if failed else 0


def provision(options: argparse.Namespace) -> int:
    """`iort-agent provision`."""
    from iort_agent.verbs import provision  # noqa: PLC0415 - as above

    written = provision.provision(options.config, robot=options.robot)
    print(f"{written} and its certificate are ready: `iort-agent check --config {written}`")
    return 0


def renew(options: argparse.Namespace) -> int:
    """`iort-agent renew`."""
    from iort_agent.verbs import provision  # noqa: PLC0415 - as above

    config = load_config(options.config)
    provision.renew(options.config, options.claim, status_socket=_socket(options, config))
    print(f"{config.robot} has a new certificate; the operator should revoke the one before")
    return 0


def init(options: argparse.Namespace) -> int:
    """`iort-agent init`."""
    from iort_agent.verbs.init import init as write  # noqa: PLC0415 - as above

    written = write(options.out, every=options.all, wanted=options.topic, listen_s=options.listen_s)
    print(f"written: {written}")
    if written == options.out:
        print("next: put it into the car.yaml of the robot's bundle, or `iort-agent init --out` that file")
    else:
        print(f"next: mv {written} {options.out} && iort-agent check --config {options.out}")
    return 0


def _socket(options: argparse.Namespace, config: Config) -> Path:
    file: Path = options.config
    return config.status_socket or file.absolute().parent / SOCKET


def _end_on_signals(runtime: Runtime) -> None:
    """The first signal ends the agent in good order, the second one at once."""
    first: float | None = None

    def on_signal(number: int, _frame: Any) -> None:
        nonlocal first
        now = time.monotonic()
        if first is None:
            first = now
        elif now - first > _SAME_SIGNAL_S:
            os._exit(128 + number)
        # No logging here: the signal may have interrupted it, and then its lock is never released.
        runtime.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)


if __name__ == "__main__":
    sys.exit(main())
