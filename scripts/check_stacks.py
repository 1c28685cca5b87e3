"""Runs the checkers over the stacks of both stages: cfn-lint, cdk-nag, checkov, and our own.

cfn-lint and our own checks also read every variation of the parameters (stacks/variations.py).

    python scripts/check_stacks.py [--checkov build/checkov/bin/checkov] [--write]

It needs no credentials and no network. stacks/acknowledged.py lists the findings that the stacks do
not follow; an entry that no checker reports any more is a finding too. --write generates
docs/explanation/acknowledged.md from it. Our own checks, stacks/checks.py, cannot be acknowledged.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from aws_cdk import App, Validations
from cdk_nag import AwsSolutionsChecks, ServerlessChecks

from app import build
from iort_contract.limits import DEFAULT_NAMESPACE
from stacks.acknowledged import Acknowledged, short
from stacks.checks import broken, unfit
from stacks.settings import Settings
from stacks.variations import VARIATIONS

DOCUMENT = ROOT / "docs" / "explanation" / "acknowledged.md"
STAGES: dict[str, dict[str, Any]] = {
    "dev": {},
    "prod": {
        "stage": "prod",
        "drivers": True,
        "turn": True,
        "customer_key": True,
        "budget_usd": 50,
        "alarm_email": "lab@example.org",
        "tags": {"team": "lab"},
        "site": True,
        "site_robots": ["car1"],
        "device_defender": True,
        "iot_log_level": "error",
    },
}


class Finding(NamedTuple):
    """A checker's finding about a construct, by its path; ``acknowledged`` if the stacks acknowledge it."""

    rule: str
    path: str
    text: str
    acknowledged: bool


def main() -> None:
    """Print the open findings; exit with 1 if any is open."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--checkov", type=Path, help="checkov's command, in its own environment")
    parser.add_argument("--write", action="store_true", help="write docs/explanation/acknowledged.md")
    asked = parser.parse_args()
    found: list[Finding] = []
    known: dict[str, list[Acknowledged]] = {}
    with TemporaryDirectory() as folder, TemporaryDirectory() as others:
        layer = Path(folder) / "layer"
        (layer / "python").mkdir(parents=True)
        for stage, given in STAGES.items():
            with timed(f"stage {stage} synthesized, cdk-nag"):
                known[stage] = synthesize(
                    Settings(layer=layer, analysis_layer=layer, **given), Path(folder) / stage
                )
                found += nag(Path(folder) / stage)
        # cdk-nag's and checkov's findings depend only on the parameters of the stages.
        with timed(f"{len(VARIATIONS)} variations synthesized"):
            for name, given in VARIATIONS.items():
                app = App(outdir=str(Path(others) / name))
                build(app, Settings(layer=layer, analysis_layer=layer, **given))
                app.synth()
        found += own(Path(folder), Path(others))
        with timed("cfn-lint"):
            found += lint(Path(folder), Path(others))
        if asked.checkov:
            with timed("checkov"):
                found += checkov(asked.checkov, Path(folder))
    findings = [finding.text for finding in found if not finding.acknowledged]
    findings += stale(known, found, unjudged=() if asked.checkov else ("CKV",))
    text = document(known)
    if asked.write:
        DOCUMENT.write_text(text)
    elif DOCUMENT.read_text() != text:
        findings.append(f"{DOCUMENT.relative_to(ROOT)} is not up to date: scripts/check_stacks.py --write")
    if findings:
        sys.exit(
            "\n".join([*findings, f"{len(findings)} open: fix, or acknowledge in stacks/acknowledged.py"])
        )


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Print what has been done, and the seconds that it took."""
    began = time.monotonic()
    yield
    print(f"check: {what} ({time.monotonic() - began:.0f} s)", flush=True)


def synthesize(settings: Settings, out: Path) -> list[Acknowledged]:
    """Write the templates and cdk-nag's report into ``out``."""
    app = App(outdir=str(out))
    known = build(app, settings)
    Validations.of(app).add_plugins(AwsSolutionsChecks(app), ServerlessChecks(app))
    try:
        app.synth()
    except RuntimeError as error:
        if "ValidationFailed" not in str(error):
            raise
    return known


def nag(out: Path) -> Iterator[Finding]:
    """cdk-nag's findings about a synthesized app; raises if a pack did not run."""
    report = json.loads((out / "validation-report.json").read_text())
    packs = {plugin["pluginName"]: plugin for plugin in report["pluginReports"]}
    for name in ("AwsSolutions", "Serverless"):
        for violation in packs[name]["violations"]:
            for construct in violation["violatingConstructs"]:
                rule, path = violation["ruleName"], construct["constructPath"]
                text = f"{out.name}: cdk-nag {rule} on {path}"
                yield Finding(rule, path, text, acknowledged=False)
        for violation in packs[name].get("suppressedViolations", []):
            rule = violation["acknowledgedId"].removeprefix(f"{name}::")
            yield Finding(rule, violation["acknowledgedAt"], "", acknowledged=True)


def templates_below(*folders: Path) -> list[Path]:
    """The different templates below the folders: most variations change one stack."""
    found = [template for folder in folders for template in sorted(folder.rglob("*.template.json"))]
    return list({template.read_bytes(): template for template in reversed(found)}.values())[::-1]


def own(*folders: Path) -> Iterator[Finding]:
    """The findings of our own checks about the templates below ``folders``."""
    for template in templates_below(*folders):
        content = json.loads(template.read_text())
        app = [json.loads(one.read_text()) for one in template.parent.glob("*.template.json")]
        for one in (*broken(content), *unfit(content, app)):
            path = _paths(template)[one.logical_id]
            yield Finding(one.check, path, f"iort {one.check} on {path}: {one.text}", acknowledged=False)


def lint(*folders: Path) -> Iterator[Finding]:
    """cfn-lint's findings about the templates below ``folders``.

    It skips findings that a resource's metadata ignores, so it reads the templates a second time without that
    metadata.
    """
    templates = templates_below(*folders)
    with TemporaryDirectory() as elsewhere:
        bare = {}
        for i, template in enumerate(templates):
            content = json.loads(template.read_text())
            ignored = [one.get("Metadata", {}).pop("cfn-lint", None) for one in content["Resources"].values()]
            if any(ignored):
                copy = Path(elsewhere) / f"{i}.template.json"
                copy.write_text(json.dumps(content))
                bare[str(copy)] = template
        command = [str(Path(sys.executable).with_name("cfn-lint")), "--format", "json", "--"]
        matches = json.loads(output([*command, *map(str, templates), *bare], good=range(16)) or "[]")
    for match in matches:
        rule, where = match["Rule"]["Id"], match["Location"]["Path"] or []
        template = bare.get(match["Filename"], Path(match["Filename"]))
        text = f"cfn-lint {rule} on {'/'.join(map(str, where))}: {match['Message']}"
        path = _paths(template)[where[1]] if where[:1] == ["Resources"] and len(where) > 1 else ""
        yield Finding(rule, path, text, acknowledged=match["Filename"] in bare)


def checkov(command: Path, folder: Path) -> Iterator[Finding]:
    """Findings of checkov about the templates below ``folder``."""
    options = ["--framework", "cloudformation", "--compact", "--skip-download", "--output", "json"]
    report = json.loads(output([str(command), "--directory", str(folder), *options], good=(0, 1)))
    if report["summary"]["parsing_errors"] or not report["summary"]["passed"]:
        sys.exit(f"checkov could not read the templates: {report['summary']}")
    for outcome in ("failed_checks", "skipped_checks"):
        for check in report["results"][outcome]:
            rule, template = check["check_id"], folder / check["file_path"].lstrip("/")
            path = _paths(template)[check["resource"].split(".", 1)[-1]]
            text = f"checkov {rule} on {check['file_path']} {path}: {check['check_name']}"
            yield Finding(rule, path, text, acknowledged=outcome == "skipped_checks")


@cache
def _paths(template: Path) -> dict[str, str]:
    """Logical id to construct path, from the CDK's metadata beside a template."""
    beside = template.with_name(template.name.replace(".template.", ".metadata."))
    return {
        entry["data"]: path.lstrip("/")
        for path, entries in json.loads(beside.read_text()).items()
        for entry in entries
        if entry["type"] == "aws:cdk:logicalId"
    }


def stale(
    known: dict[str, list[Acknowledged]], found: list[Finding], *, unjudged: tuple[str, ...] = ()
) -> Iterator[str]:
    """Acknowledged findings that no checker reports any more, in any stage; ``unjudged`` are the rule
    prefixes of checkers that did not run."""
    still = {(one.rule, short(one.path, DEFAULT_NAMESPACE)) for one in found}
    everywhere = {(one.rule, one.path): one for acknowledged in known.values() for one in acknowledged}
    for rule, path in sorted(everywhere.keys() - still):
        if not rule.startswith(unjudged):
            yield f"{rule} on {path}: not reported any more; remove it from stacks/acknowledged.py"


def output(command: list[str], *, good: Iterable[int]) -> str:
    """A tool's standard output; the tools run without network."""
    nowhere = "http://127.0.0.1:9"
    environment = {**os.environ, "HTTPS_PROXY": nowhere, "HTTP_PROXY": nowhere, "LOG_LEVEL": "ERROR"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in good:
        sys.exit(f"{command[0]} failed:\n{done.stderr or done.stdout}")
    return done.stdout


def document(known: dict[str, list[Acknowledged]]) -> str:
    """docs/explanation/acknowledged.md: rule, reason, and the acknowledged resources."""
    where: dict[tuple[str, str], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for stage, acknowledged in known.items():
        for one in acknowledged:
            where[one.rule, one.reason][one.path].add(stage)
    lines = [
        "# Findings of the checkers that the stacks do not follow",
        "",
        "Generated by `scripts/check_stacks.py --write` from",
        "[stacks/acknowledged.py](../../stacks/acknowledged.py). `make check` runs",
        "cfn-lint (W), cdk-nag (AwsSolutions, Serverless) and checkov (CKV) over both stages, prod",
        "with a customer-managed key, and fails on any other finding, or if this page is out of date.",
        "",
        "| rule | reason | resources |",
        "|---|---|---|",
    ]
    for (rule, reason), paths in sorted(where.items()):
        named = []
        for path, stages in sorted(paths.items()):
            named.append(path if stages == set(STAGES) else f"{path} ({', '.join(sorted(stages))})")
        shown = rule.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
        lines.append(f"| {shown} | {reason} | {', '.join(named)} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    main()
