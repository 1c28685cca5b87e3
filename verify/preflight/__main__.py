"""Checks an account for causes of a failed deployment, beforehand and read-only.

    python -m verify.preflight [-c key=value ...] [--profile NAME] [--derive [--unchecked]]

It reads settings like app.py, takes from the account those that are not given, and ignores other options of
the CDK. Exit status 1 means that the deployment would fail. `make deploy` runs it first, and hands to the
CDK what --derive prints, the findings beside it on stderr. `make diff`, `make destroy` and SKIP_PREFLIGHT=1
take --unchecked, which has no findings. `make verify-aws` runs the checks for its report.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from iort_contract.limits import ContractError
from iort_station.cli.console import Console
from iort_station.cloud import Cloud
from stacks.settings import ROOT, Settings, SettingsError
from verify.preflight import account, deployed
from verify.preflight.deployed import derive, namespace_of
from verify.preflight.finding import Clients, Finding, Verdict

_STYLES = {Verdict.FINE: "green", Verdict.WARNING: "yellow", Verdict.STOPS: "red"}


def look(clients: Clients, settings: Settings) -> list[Finding]:
    """All findings, in the order of a deployment."""
    who = account.credentials(clients, settings)
    if who.verdict is Verdict.STOPS:
        # All other items would get the same answer.
        return [who]
    return [who, *(ask(clients, settings) for ask in (*account.ITEMS, *deployed.ITEMS))]


def stopped(findings: Sequence[Finding]) -> bool:
    """Whether any finding stops the deployment."""
    return any(finding.verdict is Verdict.STOPS for finding in findings)


def options(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the command line; `make deploy` passes ARGS both to the CDK and to this."""
    parser = argparse.ArgumentParser(prog="verify.preflight", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-c", "--context", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--profile", help="profile of the AWS configuration")
    parser.add_argument(
        "--derive", action="store_true", help="print the CDK's arguments for what the account decides"
    )
    parser.add_argument("--unchecked", action="store_true", help="look for nothing that would fail")
    known, _others = parser.parse_known_args(arguments)
    return known


def context(given: Sequence[str]) -> Mapping[str, Any]:
    """The CDK's context for app.py: cdk.json's values, overridden by ``key=value``."""
    in_file: dict[str, Any] = json.loads((ROOT / "cdk.json").read_text()).get("context", {})
    pairs = (pair.partition("=") for pair in given)
    return {**in_file, **{key: value for key, _, value in pairs}}


def show(findings: Sequence[Finding], console: Console) -> None:
    """Print one line per finding, and below it the remedy."""
    for finding in findings:
        style = _STYLES[finding.verdict]
        text = f"{finding.verdict.value:8} {finding.item}: {finding.found}"
        console.print(text, style=style, soft_wrap=True)
        if finding.do:
            console.print(f"{'':8} -> {finding.do}", soft_wrap=True)


def main() -> None:
    """Check, print, and exit with 1 if the deployment would fail."""
    asked = options(sys.argv[1:])
    given = context(asked.context)
    try:
        clients = Cloud(namespace=namespace_of(given), profile=asked.profile)
        answers = derive(clients, given)
        settings = Settings.read({**given, **answers}.get)
    except (ContractError, SettingsError) as error:
        sys.exit(f"preflight: {error}")
    findings = [] if asked.unchecked else look(clients, settings)
    show(findings, Console(file=sys.stderr if asked.derive else sys.stdout))
    if asked.derive:
        derived = " ".join(f"-c {key}={value}" for key, value in answers.items())
        sys.stderr.write(f"by the account: {derived or 'nothing'}\n")
        sys.stdout.write(f"{derived}\n")
    if stopped(findings):
        sys.exit("preflight: nothing was deployed; SKIP_PREFLIGHT=1 deploys anyway")


if __name__ == "__main__":
    main()
