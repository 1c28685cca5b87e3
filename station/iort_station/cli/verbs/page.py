"""`iort dashboard`, `invite`, `pubnub` and `site`: the live page, here and on the web."""

from __future__ import annotations

import threading
from typing import Annotated

import typer

from iort_station import kept
from iort_station.cli.console import tell
from iort_station.cli.options import AsJson, LiveWay, Token, TrackFile, Yes, agreed, examples, option, say
from iort_station.errors import StationError
from iort_station.fleet.roles import transport
from iort_station.page import invitations
from iort_station.page.motion import everybody
from iort_station.page.page import config, load_track, publish, store_keys, typed_keys, upload

commands = typer.Typer()


@commands.command("dashboard", epilog=examples("dashboard --port 8080"))
def dashboard(
    context: typer.Context,
    port: Annotated[int, option("The page's port; 0 takes a free one.")] = 8080,
    host: Annotated[
        str,
        option(
            "The address to listen on. Whoever reaches it can read the cars' past; "
            "only a page on 127.0.0.1 sends commands."
        ),
    ] = "127.0.0.1",
    name: Annotated[
        list[str] | None, option("Another name of this server than localhost; may be repeated.")
    ] = None,
    live: LiveWay = None,
    token: Token = "",
    track: TrackFile = None,
    as_json: AsJson = False,
) -> None:
    """Serve the live page until Ctrl-C: the fleet, each car, its past, and CloudWatch's dashboards."""
    # numpy and aiohttp take longer to load than most commands to run.
    from iort_station.page import answers as control  # noqa: PLC0415 - as above
    from iort_station.page.answers import actions, answers  # noqa: PLC0415 - see above
    from iort_station.page.motion import reaching  # noqa: PLC0415 - as above
    from iort_station.page.page import load_track  # noqa: PLC0415 - as above
    from iort_station.page.server import PageServer, on_loopback  # noqa: PLC0415 - as above

    cloud = context.obj.cloud()
    known = None if track is None else load_track(track)
    with PageServer(
        namespace=cloud.namespace,
        token=token,
        answers=answers(cloud, known),
        downloads=control.downloads(cloud),
        open_actions=actions(cloud),
        # Only people at this machine may move a robot.
        actions=control.keyed_actions(cloud) if on_loopback(host) else {},
        admitted=lambda address: say(f"another browser: {address}"),
        track=known,
        host=host,
        port=port,
        invitations=kept.pages(),
        names=name or (),
        **reaching(cloud, live or transport(cloud)),
    ) as page:
        address = page.invitation()
        tell({"url": page.url, "address": address}, f"{address}  (Ctrl-C stops)", as_json=as_json)
        threading.Event().wait()


# `iort invite`: a link for one more browser.


@commands.command("invite", epilog=examples("invite", "invite --port 8080"))
def invite(
    port: Annotated[
        int | None, option("The page's port, if you serve several. Default: the only one.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print a new link to the page that you serve. The first browser that opens it may stop and drive."""
    page, address = invitations.invite(kept.pages(), port)
    tell({"url": page.url, "address": address}, address, as_json=as_json)


# `iort pubnub`: the keys that Lambda 1 publishes with.


@commands.command("pubnub", epilog=examples("pubnub"))
def pubnub(
    context: typer.Context,
    publish_key: Annotated[
        str | None, option("The publish key. Default: asks for it.", envvar="PUBNUB_PUBLISH_KEY")
    ] = None,
    subscribe_key: Annotated[
        str | None, option("The subscribe key. Default: asks for it.", envvar="PUBNUB_SUBSCRIBE_KEY")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Store PubNub's keys, encrypted, where Lambda 1 reads them."""
    # Fails for a missing cloud before anybody types a key.
    cloud = context.obj.cloud()
    if cloud.endpoint_url:
        raise StationError("the embedded cloud has a stand-in for PubNub, with its own keys")
    publish_key = publish_key or typer.prompt("Publish key", hide_input=True)
    subscribe_key = subscribe_key or typer.prompt("Subscribe key", hide_input=True)
    store_keys(cloud, typed_keys(publish_key, subscribe_key))
    tell({"stored": True}, "stored; Lambda 1 uses them after its next cold start", as_json=as_json)


# `iort site`: the page on the web.


@commands.command("site", epilog=examples("site"))
def site(
    context: typer.Context,
    token: Annotated[
        str,
        option(
            "PubNub's access token for reading. Everybody who opens the page can read it.",
            envvar="PUBNUB_ACCESS_TOKEN",
        ),
    ] = "",
    remove: Annotated[
        bool, option("Empty the bucket instead, before you destroy the stack.", "--remove")
    ] = False,
    track: TrackFile = None,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Upload the page to the stack iort-site, which serves it. Deploy with -c site=true first."""
    cloud = context.obj.cloud()
    if remove:
        agreed(f"Take the page of the deployment {cloud.namespace} down?", yes=yes)
        gone = upload(cloud.client("s3"), cloud.output("site", "PageBucket"), {})
        tell({"deleted": len(gone)}, f"{len(gone)} files deleted", as_json=as_json)
        return
    told = config(
        namespace=cloud.namespace,
        token=token,
        track=None if track is None else load_track(track),
        **everybody(cloud),
    )
    url = publish(cloud, told)
    tell({"url": url}, url, as_json=as_json)
