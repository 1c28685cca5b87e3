"""`iort robots add, register, claim, rotate, revoke-claims`: names, certificates and provisioning claims."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from iort_contract.catalog.derived import F1TENTH
from iort_station.cli.console import Lines, errors, tell
from iort_station.cli.options import AsJson, Force, Robot, Yes, agreed, to_file
from iort_station.cli.words import examples
from iort_station.errors import UsageError
from iort_station.fleet import identity, registry, robots
from iort_station.output import check_free

commands = typer.Typer()

_STOP = (
    "An emergency stop ends what downlink.cmd in car.yaml moves: the simulated car's command is there. Name "
    "your robot's own before you drive it (docs/how-to/drive.md)."
)
_Gain = Annotated[
    float | None,
    typer.Option(
        help=f"erpm per m/s (vesc.yaml). Default: {F1TENTH.speed_to_erpm_gain:g} for the page alone.",
        show_default=False,
    ),
]
_ClaimFolder = Annotated[Path, to_file("The folder to write the claim into.")]


@commands.command("add", epilog=examples("robots add car8 --out robots"))
def add(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="The robot's name.")],
    folder: Annotated[Path, to_file("Where to write the robot's folder of configuration and keys.")] = Path(),
    speed_to_erpm_gain: _Gain = None,
    as_json: AsJson = False,
) -> None:
    """Register a robot and write its folder: car.yaml, certificate and key."""
    cloud = context.obj.cloud()
    bundle = robots.add(cloud, name, out=folder, vehicle=_vehicle(speed_to_erpm_gain))
    where, config = f"Copy {bundle.folder} to it, then run there", f"{bundle.folder.name}/car.yaml"
    if cloud.mqtt_endpoint == "127.0.0.1":
        where, config = "This cloud is for robots of this machine alone; run here", str(bundle.config)
    text = f"{name} is registered. {where}:\n\n  iort-agent run --config {config}\n\n{_STOP}"
    tell(
        {"robot": name, "folder": str(bundle.folder), "config": str(bundle.config)},
        Lines(text),
        as_json=as_json,
    )


@commands.command("register", epilog=examples("robots register car20 car21 --days 7"))
def register(
    context: typer.Context,
    names: Annotated[list[str], typer.Argument(help="The robots' names.")],
    serial: Annotated[
        str | None, typer.Option(help="The serial number of the one machine that may claim the name.")
    ] = None,
    days: Annotated[
        float, typer.Option(help="How many days the name can be claimed.", min=0)
    ] = identity.DAYS,
    speed_to_erpm_gain: _Gain = None,
    as_json: AsJson = False,
) -> None:
    """Pre-register names. Any robot with one of the fleet's lasting claims can claim each name once."""
    if serial is not None and len(names) != 1:
        raise UsageError("--serial is for one machine: give one name with it")
    cloud, vehicle = context.obj.cloud(), _vehicle(speed_to_erpm_gain)
    for name in names:
        identity.register(cloud, name, serial=serial, days=days, vehicle=vehicle)
        tell({"robot": name, "days": days}, f"{name} is expected for {days:g} days", as_json=as_json)


@commands.command("claim", epilog=examples("robots claim car9 --out claim-car9"))
def claim(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="The robot's name; not with --lasting.")] = None,
    folder: _ClaimFolder = Path("claim"),
    lasting: Annotated[bool, typer.Option(help="Valid until revoked, instead of five minutes.")] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a provisioning claim, which the robot exchanges for a certificate of its own key.

    The claim is for NAME alone, which this command registers or opens again. Without a name, a lasting
    claim is for the pre-registered names (`iort robots register`), once for each.
    """
    if name is None and not lasting:
        raise UsageError("give the robot's name, or --lasting for a claim of many robots")
    check_free(folder / identity.CLAIM_FILE, force=force)
    path = identity.claim(context.obj.cloud(), name, out=folder, lasting=lasting)
    text = (
        f"Copy {folder} to the robot, then run there:\n\n"
        f"  iort-agent provision --config {folder.name}/{path.name}"
    )
    tell({"robot": name, "folder": str(folder), "claim": str(path)}, Lines(text), as_json=as_json)


@commands.command("rotate", epilog=examples("robots rotate car7 --out claim-car7 --no-wait"))
def rotate(
    context: typer.Context,
    name: Robot,
    folder: _ClaimFolder = Path("claim"),
    finish: Annotated[
        bool, typer.Option("--finish", help="The robot has its new certificate: wait, and revoke the old.")
    ] = False,
    wait: Annotated[bool, typer.Option(help="Wait for the robot, then revoke the old certificate.")] = True,
    settled_s: Annotated[
        float, typer.Option(help="Seconds that the robot must be connected with the new one.", min=0)
    ] = identity.SETTLED_S,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Give a robot a new key and certificate; revoke the old one after the new one is in use.

    The robot can connect at every moment. You may stop the command at any time: `--finish` does the rest.
    """
    cloud = context.obj.cloud()
    if not finish:
        registry.get(cloud, name)
        check_free(folder / identity.CLAIM_FILE, force=force)
        path = identity.claim(cloud, name, out=folder)
        text = (
            f"Copy {folder} to {name} within five minutes, then run there:\n\n"
            f"  iort-agent renew --config car.yaml --claim {folder.name}/{path.name}\n"
        )
        tell({"robot": name, "folder": str(folder), "claim": str(path)}, Lines(text), as_json=as_json)
    if finish or wait:
        with errors.status("waiting") as status:
            old = identity.finish_rotation(cloud, name, settled_s=settled_s, progress=status.update)
        text = f"{name} has settled with its new certificate; revoked: {len(old)}"
        tell({"robot": name, "revoked": len(old)}, text, as_json=as_json)


@commands.command("revoke-claims", epilog=examples("robots revoke-claims --yes"))
def revoke_claims(context: typer.Context, yes: Yes = False, as_json: AsJson = False) -> None:
    """Revoke every lasting claim. Robots that were provisioned with one keep their own certificate."""
    agreed("Revoke every lasting claim?", yes=yes)
    count = identity.revoke_claims(context.obj.cloud())
    tell({"claims_revoked": count}, f"lasting claims revoked: {count}", as_json=as_json)


def _vehicle(speed_to_erpm_gain: float | None) -> Mapping[str, float]:
    if speed_to_erpm_gain is None:
        return robots.F1TENTH
    own = robots.checked_vehicle({"speed_to_erpm_gain": speed_to_erpm_gain})
    return {**robots.F1TENTH, **registry.given(own)}
