"""A viewer has a car keep a minute: from the page's button to the file, on the embedded cloud."""

from __future__ import annotations

from mcap.reader import make_reader

from iort_contract.tables import ONLINE
from iort_station.fleet import registry
from iort_station.page.answers import actions, answers, downloads, keyed_actions
from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.local.conftest import recorded
from tests.local.data.drives import Agent


def test_the_last_minute_is_kept_listed_and_downloaded(embedded, bundle, open_page, tmp_path):
    cloud = embedded.cloud
    source = {"type": "sim", "stream": "vesc", "rate_hz": 20}
    car = bundle(sources=[source], recorder={}, live={"when": "always"})
    server = PageServer(
        namespace=embedded.namespace,
        **embedded.keys.reading(),
        answers=answers(cloud),
        downloads=downloads(cloud),
        open_actions=actions(cloud),
        actions=keyed_actions(cloud),
    )
    with server, Agent(car):
        until(lambda: registry.get(cloud, car.robot).get(ONLINE), "the car")
        recorded(embedded, car.robot, "vesc")
        page = open_page(server.invitation(f"#/car/{car.robot}"), accept_downloads=True)
        until(lambda: page.get_by_role("button", name="Keep the last 60 s").is_visible(), "the car's page")
        page.get_by_role("button", name="Keep the last 60 s").click()
        page.get_by_text(f"{car.robot} keeps them, and uploads them.").wait_for()
        page.locator(".incidents-list [data-state=uploaded]").wait_for()
        with page.expect_download() as loading:
            page.locator(".incidents-list").get_by_role("button", name="Download").click()
        loading.value.save_as(tmp_path / "file.mcap")
        page.goto(f"{server.url}#/")
        until(lambda: page.locator(".incidents-badge").first.inner_text() == "1 incident", "the badge")
    with (tmp_path / "file.mcap").open("rb") as file:
        assert {channel.topic for _, channel, _ in make_reader(file).iter_messages()} >= {"vesc"}
