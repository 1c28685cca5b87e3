"""`make verify-aws`: asks an AWS account about all assumptions of the design.

    python -m verify.run [--target aws|embedded] [--only rules,files] [--yes] [--out build/verify] [--keep]

It checks the account, prints the costs and asks for confirmation. It creates the stacks under a namespace of
their own, asks the questions, changes to a key of the account's own and to a page that anybody may see, and
asks the questions about that. It removes everything at the end, also after Ctrl-C. It writes report.json and
report.md. Exit status 1 if an answer differs, 2 if a question failed or something was left over.
"""

from __future__ import annotations

import argparse
import getpass
import secrets
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from botocore.exceptions import BotoCoreError, ClientError
from rich.console import Console
from rich.markup import escape

from iort_station.cloud import Cloud
from iort_station.errors import StationError
from local.deployment import ROOT
from local.processes import LocalError
from stacks.settings import Settings
from testkit import machine
from testkit.command import confirm, wound_up
from testkit.target import AWS, EMBEDDED, Target, open_target
from testkit.waiting import InstrumentError
from verify import report
from verify.deployment import CHANGES, Deployment
from verify.preflight import __main__ as preflight
from verify.question import CHANGED, ENDED, FIRST, Answer, Question, Verdict, ask
from verify.questions import ALL
from verify.questions.live import keys_lent

OUT = ROOT / "build" / "verify"
# Of all questions, at the list prices of 2026; alarms and metrics are most of it.
DOLLARS = 0.26
_STYLES = {
    Verdict.AS_ASSUMED: "green",
    Verdict.DIFFERS: "red",
    Verdict.NOT_ASKED: "yellow",
    Verdict.FAILED: "red",
}


def main() -> None:
    """Ask, write and print."""
    try:
        sys.exit(run(_options()))
    except KeyboardInterrupt:
        sys.exit(130)
    except (LocalError, StationError, InstrumentError, BotoCoreError, ClientError) as error:
        Console(stderr=True).print(f"verify: {error}", style="red", markup=False)
        sys.exit(2)


def run(options: argparse.Namespace, cloud: Cloud | None = None, deployment: Deployment | None = None) -> int:
    """Return the exit status; ``cloud`` and ``deployment`` replace those made from the options."""
    console, began = Console(), time.monotonic()

    def say(text: str) -> None:
        # A terminal that has gone must not end the putting back.
        with suppress(OSError):
            seconds = time.monotonic() - began
            console.print(f"{seconds:6.1f} s    {escape(text)}", highlight=False, style="dim")

    answers: list[Answer] = []
    region, leftovers, findings = "", list[str](), list[str]()
    with wound_up(console) as putting_back:
        if options.target == AWS:
            cloud = (cloud or Cloud(namespace=options.namespace)).check()
            options.out.mkdir(parents=True, exist_ok=True)
            deployment = deployment or Deployment(cloud, options.out, say)
            findings = _looked(cloud, console)
            if not options.yes:
                confirm(console, _announced(cloud), InstrumentError)
        try:
            if deployment:
                deployment.deploy({})
            with (
                open_target(options.target, namespace=options.namespace, cloud=cloud, say=say) as target,
                ExitStack() as lent,
            ):
                # Several questions need them; without, these are not asked.
                with suppress(InstrumentError, StationError, ClientError):
                    lent.enter_context(keys_lent(target))
                region = target.cloud.client("iot").meta.region_name
                # One by one, so that the report has all answers before an interrupt.
                answers.extend(_asked(options.only, FIRST, target, console))
                if deployment and any(question.phase == CHANGED for question in options.only):
                    deployment.deploy(CHANGES)
                answers.extend(_asked(options.only, CHANGED, target, console))
                if deployment:
                    target.destroy = deployment.destroy
                answers.extend(_asked(options.only, ENDED, target, console))
        finally:
            putting_back()
            if deployment:
                leftovers = deployment.destroy()
            if answers:
                here = machine.describe()
                described = report.Run(
                    target="AWS" if options.target == AWS else "the embedded cloud",
                    region=region,
                    by=options.by,
                    date=here["date"],
                    version=here["commit"],
                    preflight=findings,
                    left_over=leftovers,
                )
                report.write(options.out, described, answers)
            for line in leftovers:
                say(f"left over: {line}")
    say(f"{report.summary(answers)}: {options.out / 'report.md'}")
    if options.keep:
        shutil.copyfile(options.out / "report.json", report.KEPT)
        say(f"kept in {report.KEPT}: `python -m verify.report` writes docs/explanation/assumptions.md")
    verdicts = {answer.verdict for answer in answers}
    return 2 if Verdict.FAILED in verdicts or leftovers else int(Verdict.DIFFERS in verdicts)


def _asked(questions: Sequence[Question], phase: str, target: Target, console: Console) -> Iterator[Answer]:
    """Ask the questions of a phase in order, and print each verdict."""
    # The embedded cloud must give AWS' measured answers.
    known = report.load() if target.kind == EMBEDDED else report.Measured()
    these = [question for question in questions if question.phase == phase]
    for number, question in enumerate(these, 1):
        answer = ask(question, target, time.monotonic, known.seen.get(question.name))
        console.print(
            f"  {number:2d} of {len(these)}  [bold]{question.name}[/]  "
            f"[{_STYLES[answer.verdict]}]{answer.verdict.value}[/]  {answer.took_s:.1f} s",
            highlight=False,
        )
        lines = [answer.reason] if answer.reason else []
        if answer.verdict is Verdict.DIFFERS:
            lines = [f"{key}: expected {want}, got {got}" for key, want, got in report.differences(answer)]
        for line in lines:
            console.print(report.redacted(f"      {line}"), markup=False)
        yield answer


def _looked(cloud: Cloud, console: Console) -> list[str]:
    """The preflight's lines for the report. Raises `InstrumentError` if the deployment would fail."""
    findings = preflight.look(cloud, Settings(namespace=cloud.namespace))
    lines = list(map(str, findings))
    console.print(report.redacted("\n".join(lines)), markup=False, highlight=False)
    if preflight.stopped(findings):
        raise InstrumentError("nothing was created: the preflight says what to do")
    return lines


def _announced(cloud: Cloud) -> str:
    return (
        f"This takes about an hour and costs about ${DOLLARS:.2f} at list prices. It creates the stacks of "
        f"namespace {cloud.namespace}, asks them, and removes them with all their data. A key of the "
        "account's own is scheduled for deletion, which AWS does not charge for."
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="verify", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--target", choices=(AWS, EMBEDDED), default=AWS)
    parser.add_argument("--only", type=_selected, default=ALL, help="subjects or questions, with commas")
    parser.add_argument("--namespace", default=f"verify{secrets.token_hex(3)}")
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the report (build/verify)")
    parser.add_argument("--by", default=getpass.getuser(), help="your name, for the report")
    parser.add_argument("--yes", action="store_true", help="spend money without confirmation")
    parser.add_argument("--keep", action="store_true", help="keep the answers in the repository")
    options = parser.parse_args()
    if options.keep and options.target != AWS:
        parser.error("--keep: only answers of AWS are kept")
    if options.keep and options.only != ALL:
        parser.error("--keep: what is kept takes the place of all earlier answers: leave --only away")
    return options


def _selected(text: str) -> tuple[Question, ...]:
    wanted = set(text.split(","))
    chosen = tuple(question for question in ALL if {question.name, question.subject} & wanted)
    known = {question.name for question in chosen} | {question.subject for question in chosen}
    if unknown := sorted(wanted - known):
        names = ", ".join(dict.fromkeys(question.subject for question in ALL))
        raise argparse.ArgumentTypeError(f"no question {', '.join(unknown)}; subjects are {names}")
    return chosen


if __name__ == "__main__":
    main()
