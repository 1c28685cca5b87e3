"""The verbs of `iort`, in a module for what belongs together.

A verb reads its options, calls its room of the station and prints the result. To add one, write a function
with `@commands.command` in a module whose ``commands`` is a `typer.Typer`, and add a line here: the verb, its
module, and what `iort --help` says of it. The order is that of `iort --help`.

`iort` imports a module only when somebody uses one of its verbs: so `iort --help` and the completion of a
verb's name import none, and a verb imports only what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

VERBS = {
    "robots": ("robots", "The robots that may connect."),
    "files": ("files", "Bags, images and other files that robots have uploaded."),
    "pubnub": ("page", "Store PubNub's keys, encrypted, where Lambda 1 reads them."),
    "dashboard": ("page", "Serve the live page until Ctrl-C."),
    "invite": ("page", "Print a link for one more browser that may stop and drive."),
    "cost": ("cost", "Print the cost of a fleet, at list prices."),
    "archive": ("upkeep", "Telemetry that is kept for good: show, run, verify."),
    "audit": ("audit", "Prove that every sample of a robot arrived."),
    "streams": ("runs", "List a robot's streams: fields, runs, times."),
    "runs": ("runs", "List the runs of a robot's agent."),
    "query": ("samples", "Print recorded samples."),
    "export": ("samples", "Write a recording: MCAP, a bag, or a dataset to learn from."),
    "plot": ("samples", "Draw recorded samples."),
    "bridge": ("bridge", "Serve robots, live or past, for Foxglove and PlotJuggler."),
    "laps": ("laps", "List laps: time, distance, energy, and compare two."),
    "analyse": ("analysis", "Analyse robots' drives in the cloud, now."),
    "findings": ("analysis", "List what the analysis found about drives."),
    "mcp": ("mcp", "Answer programs that ask, by the Model Context Protocol."),
    "note": ("analysis", "Write, list or delete notes about a robot."),
    "recorder": ("triggers", "What robots keep of what happened, and when."),
    "incidents": ("incidents", "List or download what robots have kept."),
    "calibrate": ("laps", "Print a car's parameters, for vesc.yaml too."),
    "trace": ("live", "Measure the delay of live updates, hop by hop."),
    "watch": ("live", "Show every car in the terminal, live, until Ctrl-C."),
    "site": ("page", "Upload the page to the stack iort-site, which serves it."),
    "alarms": ("alarms", "List the alarms with what to do, or acknowledge them."),
    "webhook": ("webhook", "Send incidents to a program of yours, signed."),
    "errors": ("alarms", "List rejected messages, or show one."),
    "replay-errors": ("alarms", "Process rejected recordings again."),
    "doctor": ("upkeep", "Say what is wrong with the cloud, or will be, and what to do."),
    "backup": ("upkeep", "Write the cloud of `make up` into one file, while it runs."),
    "restore": ("upkeep", "Make the cloud of `make up` from a backup."),
    "import": ("imports", "Import recordings, as if the robot had driven."),
    "move": ("move", "Copy robots and their recordings into another cloud."),
    "send": ("control", "Send a command and print the robot's answer."),
    "drive": ("drive", "Drive a car by the keys of this terminal."),
    "sight": ("sight", "Say what the driver of each command saw, and how old it was."),
    "stop": ("control", "Stop robots in an emergency, until --release."),
    "ask": ("control", "Ask the cloud what a robot may ask."),
    "config": ("control", "Show or change a robot's settings."),
}


class Verb(TyperCommand):
    """A verb: its name and its line of help, and the command itself as soon as it is used."""

    def __init__(self, name: str) -> None:
        module, summary = VERBS[name]
        super().__init__(name, short_help=summary)
        self._module = f"{__name__}.{module}"

    def load(self) -> Any:
        # A group of its own gives the command its name, and no options for completion.
        group = typer.Typer(add_completion=False, rich_markup_mode=None)
        group.add_typer(import_module(self._module).commands)
        return typer.main.get_group(group).commands[str(self.name)]

    def make_context(self, info_name: str | None, args: list[str], *given: Any, **named: Any) -> Any:
        """The context of the command, which then takes the verb's place."""
        if named.get("resilient_parsing") and args and args[-1].startswith("-"):
            # TAB asks for the value of this option; without it the parser would give up, and know no robot.
            args = args[:-1]
        return self.load().make_context(info_name, args, *given, **named)


class Verbs(TyperGroup):
    """Every verb of the list."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        for name in VERBS:
            self.add_command(Verb(name))
