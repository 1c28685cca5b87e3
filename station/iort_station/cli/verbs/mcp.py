"""`iort mcp`: answers programs that ask, by the Model Context Protocol."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from iort_station.cli.console import print_json
from iort_station.cli.options import examples, option, say
from iort_station.errors import StationError

commands = typer.Typer()


@commands.command("mcp", epilog=examples("mcp --policy"))
def mcp(
    context: typer.Context,
    policy: Annotated[bool, option("Print the IAM policy that it needs, and end.", "--policy")] = False,
) -> None:
    """Answer questions of an MCP client on standard input and output, until it closes them.

    The client starts this command. It may ask about robots, streams, samples and their statistics, runs,
    findings, incidents, the audit, refused messages and cost, and read the documentation. It changes nothing
    in the cloud, and moves no robot.
    """
    try:
        import anyio  # noqa: PLC0415 - an extra

        from iort_station import mcp as room  # noqa: PLC0415 - as above
    except ImportError as error:
        raise StationError(
            f"MCP's SDK is not installed ({error}): pip install 'iort-station[mcp]'"
        ) from error
    cloud = context.obj.cloud()
    if policy:
        print_json(room.policy(cloud))
        return
    say("waiting for an MCP client on standard input")
    anyio.run(partial(room.serve, cloud))
