"""The CDK app: builds the stacks and passes objects from one to the next.

Needs no credentials, no network and no Docker. What may differ between deployments is in
stacks/settings.py.
"""

from __future__ import annotations

import os
import sys

try:
    from aws_cdk import App, Stack, Tags
except ModuleNotFoundError as missing:
    sys.exit(f"app.py: no module {missing.name} for {sys.executable}: `make layer` sets up .venv/bin/python")

from stacks.account import Account
from stacks.acknowledged import Acknowledged, acknowledge
from stacks.analysis import Analysis
from stacks.archive import Archive
from stacks.fleet import Fleet
from stacks.ingest import Ingest
from stacks.monitoring import Monitoring
from stacks.processing import Processing
from stacks.quarantine import Quarantine
from stacks.settings import Settings, SettingsError
from stacks.site import Site
from stacks.storage import Storage


def build(app: App, settings: Settings) -> list[Acknowledged]:
    """Add every stack to the app; returns what is told to the independent checkers."""
    storage = Storage(app, settings)
    quarantine = Quarantine(app, settings, storage)
    fleet = Fleet(app, settings, storage=storage, quarantine=quarantine)
    called = {"presence": fleet.presence}
    processing = Processing(app, settings, storage=storage, quarantine=quarantine, called=called)
    Ingest(app, settings, storage=storage, quarantine=quarantine, functions=processing.called)
    archive = Archive(app, settings, storage=storage, quarantine=quarantine)
    analysis = Analysis(app, settings, storage=storage, alarms=processing.alarms)
    watched = (storage, quarantine, fleet, processing, archive, analysis)
    Monitoring(app, settings, stacks=watched, topic=processing.alarms)
    if settings.site:
        Site(app, settings)
    if settings.account_wide:
        others = [one for one in app.node.children if isinstance(one, Stack)]
        account = Account(app, settings)
        for other in others:
            account.add_stack_dependency(other)
    for key, value in {"project": settings.namespace, "stage": settings.stage, **settings.tags}.items():
        Tags.of(app).add(key, value)
    return acknowledge(app, settings)


def main() -> None:
    """Synthesize into the folder that the CDK CLI asks for, cdk.out otherwise."""
    app = App(outdir=os.environ.get("CDK_OUTDIR", "cdk.out"))
    try:
        build(app, Settings.from_context(app))
    except SettingsError as error:
        sys.exit(f"app.py: {error}")
    app.synth()


if __name__ == "__main__":
    main()
