"""The page's web server, over loopback: its files, its rejections, and the secrets that it never sends."""

from __future__ import annotations

import asyncio
import gzip
import http.client
import json
import socket
import stat
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, closing, suppress
from functools import partial
from urllib.parse import urlsplit

import pytest
from aiohttp import web

from iort_station.errors import StationError, UsageError
from iort_station.page import invitations
from iort_station.page.background import BackgroundServer
from iort_station.page.history import MOST_BYTES
from iort_station.page.page import BUILT, config, load_track
from iort_station.page.server import PageServer, on_loopback
from testkit.ports import free_port
from testkit.waiting import GUARD_S
from tests.web.cars import SETTINGS


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "web"
    folder.mkdir()
    (folder / "index.html").write_text("<!doctype html><title>page</title>")
    (folder / "page.js").write_text("'use strict'")
    (folder / "style.css").write_text("body {}")
    (folder / "page.bin").write_text("no type of its own: not served")
    (folder.parent / "secret.json").write_text("{}")
    return folder


@pytest.fixture(scope="module")
def plain(built):
    """A page with nothing but its files."""
    with PageServer(**SETTINGS, built=built) as page:
        yield page


def ask(page, path, method="GET", headers=None, body=None):
    address = urlsplit(page.url)
    with closing(
        http.client.HTTPConnection(address.hostname or "", address.port, timeout=GUARD_S)
    ) as connection:
        connection.request(method, path, body and body.encode(errors="surrogatepass"), headers or {})
        answer = connection.getresponse()
        return answer, answer.read()


def config_of(page):
    return json.loads(ask(page, "/config.json")[1])


def post(page, name, body, kind="application/json", **more):
    """Ask for an action from the page's own origin."""
    headers = {"Host": "localhost", "Origin": "http://localhost", "Content-Type": kind}
    headers |= {name.replace("_", "-"): value for name, value in more.items()}
    answer, content = ask(page, f"/{name}.json", "POST", headers, body)
    return answer.status, json.loads(content)


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/", "text/html; charset=utf-8"),
        ("/index.html?x=1", "text/html; charset=utf-8"),
        ("/page.js", "text/javascript; charset=utf-8"),
        ("/style.css", "text/css; charset=utf-8"),
        ("/config.json", "application/json"),
    ],
)
def test_files_come_with_their_type_and_the_policy(plain, path, kind):
    answer, body = ask(plain, path)
    packed, packed_body = ask(plain, path, headers={"Accept-Encoding": "gzip, br"})
    head, no_body = ask(plain, path, "HEAD")
    assert answer.status == 200
    assert answer.headers["Content-Type"] == kind
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'self' http://127.0.0.1:9;" in policy
    assert "unsafe" not in policy
    assert packed.headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(packed_body) == body
    assert head.headers["Content-Length"] == str(len(body))
    assert no_body == b""


@pytest.mark.parametrize(
    "path",
    ["/no", "/.", "/..", "/../secret.json", "/%2e%2e/secret.json", "//etc/passwd", "/page.js/", "/page.bin"],
)
def test_other_paths_are_not_served(plain, path):
    answer, body = ask(plain, path)
    assert answer.status == 404
    assert b"<" not in body
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]


def test_a_cached_file_is_not_sent_again(plain):
    etag = ask(plain, "/page.js")[0].headers["ETag"]
    again, body = ask(plain, "/page.js", headers={"If-None-Match": etag, "Accept-Encoding": "gzip"})
    other, _ = ask(plain, "/style.css", headers={"If-None-Match": etag})
    assert (again.status, again.headers["ETag"], body) == (304, etag, b"")
    assert "default-src 'none'" in again.headers["Content-Security-Policy"]
    assert other.status == 200


def test_a_slow_answer_delays_neither_a_file_nor_the_shutdown(built):
    asked, done = threading.Event(), threading.Event()

    def slow(_asked):
        asked.set()
        done.wait()
        return {}

    try:
        with (
            PageServer(**SETTINGS, built=built, answers={"slow": slow}) as page,
            socket.create_connection((page.host, page.port)) as waiting,
        ):
            waiting.sendall(b"GET /slow.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert asked.wait(GUARD_S)
            assert ask(page, "/page.js")[0].status == 200
            page.stop()
            assert waiting.recv(1) == b""
    finally:
        done.set()


def test_the_configuration_has_the_track_of_a_file(built, tmp_path):
    file = tmp_path / "track.csv"
    file.write_text("# x_m, y_m, w_right_m, w_left_m\n0,0,1,2\n4,0,1,2\n4,3,1,2\n0,3,1,2\n")
    with PageServer(**SETTINGS, built=built, track=load_track(file)) as page:
        track = config_of(page)["track"]
    assert track == {"x_m": [0, 4, 4, 0], "y_m": [0, 0, 3, 3], "w_right_m": [1] * 4, "w_left_m": [2] * 4}
    file.write_text("0,0\n")
    with pytest.raises(StationError, match=r"track.csv: line 1 must be the four numbers"):
        load_track(file)


def test_a_malformed_request_is_answered_without_a_traceback(built, caplog, monkeypatch):
    with PageServer(**SETTINGS, built=built) as page:
        with socket.create_connection((page.host, page.port)) as sender:
            sender.sendall(b"GET / HTTP/1.1\r\nBad Header\r\n\r\n")
            assert sender.recv(100).startswith(b"HTTP/1.0 400 ")
        assert not caplog.records
        # A fault of our own is still logged.
        monkeypatch.setattr(page, "_accepts", None)
        assert ask(page, "/")[0].status == 500
    assert [record.levelname for record in caplog.records] == ["ERROR"]


@pytest.mark.parametrize(
    ("accepted", "packed"),
    [
        ("gzip", True),
        ("br;q=1.0, GZIP; q=0.001", True),
        ("*", True),
        ("gzip;q=0", False),
        ("gzip; q=0.000, *", False),
        ("identity, *;q=0", False),
        ("xgzip", False),
    ],
)
def test_gzip_is_sent_only_if_it_is_accepted(plain, accepted, *, packed):
    answer, _ = ask(plain, "/page.js", headers={"Accept-Encoding": accepted})
    assert (answer.headers["Content-Encoding"] == "gzip") is packed


def test_other_methods_are_rejected(plain):
    assert ask(plain, "/", "POST")[0].status == 405


def test_an_action_needs_a_post_of_json_from_the_page_itself(built):
    """A page elsewhere has neither this origin nor the key, and a form cannot send this type."""
    done = []

    def act(asked):
        done.append(asked)
        if not asked:
            raise StationError("nothing was asked")
        return {"done": True}

    with PageServer(**SETTINGS, actions={"act": act}, open_actions={"note": act}, built=built) as page:
        key = post(page, "key", json.dumps({"token": page.invitation().rpartition("=")[2]}))[1]["key"]
        act_ = partial(post, page, "act", X_Iort_Key=key)
        assert ask(page, "/act.json")[0].status == 404
        assert act_('{"a": "b"}', "text/plain")[0] == 415
        assert act_('{"a": "b"}', Host="evil.example")[0] == 403
        for origin in ("", "null", "http://evil.example", "http://localhost:81"):
            assert act_('{"a": "b"}', Origin=origin)[0] == 403
        for other in ("", "x", "\u00e4"):
            assert act_('{"a": "b"}', X_Iort_Key=other)[0] == 403
        for wrong in ("", "[]", '{"a": 1}', "\ud800"):
            assert act_(wrong)[0] == 400
        assert act_("[" * 100_000)[0] == 400
        assert act_("{}", "application/json; charset=nonsense")[0] == 400
        assert not done
        assert act_("{}") == (400, {"error": "nothing was asked"})
        assert act_('{"a": "b"}') == (200, {"done": True})
        # What everybody may do needs no key, but the page's own origin as well.
        assert post(page, "note", '{"c": "d"}') == (200, {"done": True})
        assert post(page, "note", '{"c": "d"}', Origin="http://evil.example")[0] == 403
    assert done == [{}, {"a": "b"}, {"c": "d"}]


def test_the_key_comes_once_for_each_invitation_and_is_in_no_file(built):
    shown = []

    def token(address):
        return json.dumps({"token": address.rpartition("=")[2]})

    with PageServer(**SETTINGS, actions={"act": lambda _: {}}, admitted=shown.append, built=built) as page:
        address = page.invitation("#/car/car-1")
        assert address.startswith(f"{page.url}#/car/car-1?key=")
        for wrong in ("{}", '{"token": "x"}', '{"token": ""}', '{"token": "\u00e4"}'):
            assert post(page, "key", wrong)[0] == 400
        assert post(page, "key", token(address), Origin="http://evil.example")[0] == 403
        status, answer = post(page, "key", token(address))
        assert status == 200
        assert post(page, "key", token(address))[0] == 400
        # A reload asks whether the kept key is still good.
        assert post(page, "key", json.dumps({"token": answer["key"]})) == (200, answer)
        assert len(shown) == 1
        assert post(page, "key", token(shown[0])) == (200, answer)
        known = config_of(page)
    assert answer["key"] not in str(known)
    assert known["keyed"] == ["act"]
    with PageServer(**SETTINGS, open_actions={"act": lambda _: {}}, built=built) as page:
        assert page.invitation() == f"{page.url}#/"


@pytest.mark.parametrize("place", ["pages", "a" * 120])
def test_a_command_gives_another_browser_the_key(built, tmp_path, place):
    folder = tmp_path / place
    keyed = {"actions": {"act": lambda _: {}}, "built": built, "invitations": folder}
    with PageServer(**SETTINGS, **keyed) as page:
        assert config_of(page)["invite"] == "iort invite"
        # Nobody else may enter, and no file has a key.
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert [stat.S_ISSOCK(one.stat().st_mode) for one in folder.iterdir()] == [True]
        tokens = []
        for _ in range(2):
            found, address = invitations.invite(folder)
            assert (found.url, address.startswith(f"{page.url}#/?key=")) == (page.url, True)
            tokens.append(json.dumps({"token": address.rpartition("=")[2]}))
        for token in tokens:
            assert post(page, "key", token)[0] == 200
            status, refused = post(page, "key", token)
            assert (status, "`iort invite`" in refused["error"]) == (400, True)
        assert "`iort invite`" in post(page, "act", "{}")[1]["error"]
        with PageServer(**SETTINGS, **keyed) as other:
            assert [one.url for one in invitations.served(folder)] == sorted([page.url, other.url])
            with pytest.raises(UsageError, match=r"several pages are served: .*--port"):
                invitations.invite(folder)
            assert invitations.invite(folder, other.port)[1].startswith(other.url)
        with pytest.raises(UsageError, match=f"got 1; there is {page.url}"):
            invitations.invite(folder, 1)
    with pytest.raises(StationError, match="you serve no page"):
        invitations.invite(folder)


def test_the_socket_of_a_killed_server_is_no_page(built, tmp_path):
    with socket.socket(socket.AF_UNIX) as killed:
        port = free_port()
        killed.bind(str(tmp_path / f"{port}.sock"))
    assert not invitations.served(tmp_path)
    keyed = {"act": lambda _: {}}
    with PageServer(**SETTINGS, actions=keyed, built=built, invitations=tmp_path, port=port) as page:
        assert [one.url for one in invitations.served(tmp_path)] == [page.url]


def test_a_page_without_a_folder_for_invitations_is_served(built, tmp_path, caplog):
    (tmp_path / "file").touch()
    keyed = {"act": lambda _: {}}
    with PageServer(**SETTINGS, actions=keyed, built=built, invitations=tmp_path / "file" / "pages") as page:
        assert ask(page, "/page.js")[0].status == 200
    assert "`iort invite` does not know this page" in caplog.text


@pytest.mark.parametrize(
    ("hosts", "own"),
    [
        (("127.0.0.1", "127.1.2.3", "::1", "localhost"), True),
        (("", "0.0.0.0", "::", "192.168.1.7", "lab.example", "127.0.0.1.example"), False),
    ],
)
def test_only_a_server_on_loopback_may_move_a_robot(hosts, *, own):
    assert [on_loopback(host) for host in hosts] == [own] * len(hosts)


def test_without_pubnub_the_page_may_connect_to_the_broker_only(built):
    broker = "wss://abc-ats.iot.eu-west-1.amazonaws.com"
    drive = {"drive": lambda _asked: {}}
    with PageServer(namespace="iort", live="iot", broker=broker, actions=drive, built=built) as page:
        answer, body = ask(page, "/config.json")
    assert f"connect-src 'self' {broker};" in answer.headers["Content-Security-Policy"]
    known = json.loads(body)
    assert (known["live"], known["drivers"], known["subscribe_key"]) == ("iot", True, "")


def test_the_page_receives_only_its_pubnub_settings(built):
    vehicles = {"car-1": {"speed_to_erpm_gain": 4614.0}}
    with PageServer(**SETTINGS, vehicles=vehicles, built=built) as page:
        known = config_of(page)
    nothing = {"actions": [], "keyed": [], "invite": "", "track": None}
    nothing |= {"live": "pubnub", "drivers": False, "identity": None}
    assert known == {**SETTINGS, "vehicles": vehicles, "token": "", "answers": False, **nothing}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"namespace": "Iort!"}, "namespace"),
        ({"subscribe_key": "pub-c-1"}, "must not be a publish or secret key"),
        ({"subscribe_key": "sec-c-1"}, "must not be a publish or secret key"),
        ({"subscribe_key": ""}, "subscribe_key"),
        ({"token": "a b"}, "access token"),
        ({"origin": "evil.example; script-src *"}, "origin"),
        ({"origin": "https://ps.pndsn.com"}, "origin"),
        ({"vehicles": {"a/b": {}}}, "robot name"),
        ({"vehicles": {"car": {"speed_to_erpm_gain": 0.0}}}, "speed_to_erpm_gain"),
        ({"vehicles": {"car": {"speed_to_erpm_gain": float("nan")}}}, "speed_to_erpm_gain"),
    ],
)
def test_invalid_page_settings_are_rejected(change, says):
    with pytest.raises(StationError, match=says):
        config(**{**SETTINGS, **change})


def test_a_port_that_is_taken_or_none_is_an_error(built):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(StationError, match=f"port {port}: the port is in use"):
            PageServer(**SETTINGS, port=port, built=built).start()
    for port in (-1, 70_000):
        with pytest.raises(StationError, match="cannot serve the page"):
            PageServer(**SETTINGS, port=port, built=built).start()


def test_an_error_explains_how_to_build_the_page(tmp_path):
    with pytest.raises(StationError, match="make setup"):
        PageServer(**SETTINGS, built=tmp_path)


def test_the_port_is_free_after_the_shutdown_although_a_connection_is_silent(built):
    page = PageServer(**SETTINGS, built=built).start()
    with socket.create_connection(("127.0.0.1", page.port)):
        page.stop()
        page.stop()
    with PageServer(**SETTINGS, built=built, port=page.port) as again:
        assert ask(again, "/")[0].status == 200


@pytest.mark.skipif(not socket.has_ipv6, reason="this machine has no IPv6")
def test_the_server_supports_ipv6(built):
    try:
        page = PageServer(**SETTINGS, built=built, host="::1").start()
    except StationError as error:
        pytest.skip(f"this machine has no IPv6 loopback: {error}")
    try:
        assert page.url == f"http://[::1]:{page.port}/"
        assert ask(page, "/")[0].status == 200
    finally:
        page.stop()


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_every_path_rejects_a_foreign_host_name(built, host):
    """DNS rebinding: a foreign page points its own name to this server to read the answers."""
    answers = {"double": lambda asked: {"twice": 2 * int(asked["n"])}}
    others = (
        "evil.example",
        "evil.example:80",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "",
        "[x]",
    )
    ours = ("localhost", "LOCALHOST:8080", "127.0.0.1", "[::1]:80", "192.168.1.7:8080", "lab.example:80")
    status = dict.fromkeys(("/", "/page.js", "/config.json", "/double.json?n=1"), 200)
    status |= dict.fromkeys(("/no", "http://elsewhere/page.js"), 404)
    with PageServer(**SETTINGS, built=built, answers=answers, host=host, names=["Lab.example"]) as page:
        for path, known in status.items():
            for name in others:
                answer, body = ask(page, path, headers={"Host": name})
                assert (answer.status, SETTINGS["subscribe_key"].encode() in body) == (403, False), name
                assert ask(page, path, "HEAD", headers={"Host": name})[0].status == 403
            for name in ours:
                assert ask(page, path, headers={"Host": name})[0].status == known, name


def test_an_answer_is_json_with_null_for_what_json_has_not_and_an_error_too(built):
    def answer(asked):
        if "n" not in asked:
            raise StationError("the request names no n")
        return {"mean": [1.5, float("inf"), None], "of": {"x": float("nan")}, "n": int(asked["n"])}

    with PageServer(**SETTINGS, built=built, answers={"double": answer}) as page:
        good, body = ask(page, "/double.json?n=21")
        bad, reason = ask(page, "/double.json")
        assert config_of(page)["answers"] is True
    assert (good.status, json.loads(body)) == (200, {"mean": [1.5, None, None], "of": {"x": None}, "n": 21})
    assert (bad.status, json.loads(reason)) == (400, {"error": "the request names no n"})


def test_the_pubnub_sdk_is_served_unmodified_with_its_licence():
    modules = BUILT.parents[3] / "node_modules" / "pubnub"
    if not (BUILT / "index.html").is_file():
        pytest.skip("the live page is not built: npm run build")
    published = (modules / "dist" / "web" / "pubnub.min.js").read_bytes()
    assert (BUILT / "pubnub.min.js").read_bytes() == published
    assert (modules / "LICENSE").read_text().strip() in (BUILT / "licences.txt").read_text()


class Failing(BackgroundServer):
    """Its loop and its look for silent connections fail once each, at the second time."""

    def __init__(self):
        super().__init__("127.0.0.1", 0, idle_s=30.0)
        self.starts, self.looks = 0, 0
        self.fail, self.again, self.looked = asyncio.Event(), threading.Event(), threading.Event()

    async def handle(self, request):
        self.fail.set()
        return web.Response()

    @asynccontextmanager
    async def beside(self):
        self.starts += 1
        if self.starts > 1:
            self.again.set()
            yield
            return
        failing = asyncio.create_task(self.fail.wait())
        serving = asyncio.current_task()
        assert serving is not None
        failing.add_done_callback(lambda _: serving.cancel())
        try:
            yield
        except asyncio.CancelledError as cancelled:
            raise RuntimeError("a fault of the loop") from cancelled

    async def pause(self, seconds):
        self.looks += 1
        if self.looks == 1:
            raise RuntimeError("a fault of the look")
        self.looked.set()
        await super().pause(seconds)


def test_each_task_of_a_server_goes_on_after_an_unexpected_exception(caplog):
    def ask_it(server):
        with closing(http.client.HTTPConnection("127.0.0.1", server.port, timeout=GUARD_S)) as connection:
            connection.request("GET", "/")
            return connection.getresponse().status

    with Failing() as server:
        port = server.port
        assert server.looked.wait(GUARD_S)
        assert "Failing's closing of silent connections has failed" in caplog.text
        with suppress(OSError, http.client.HTTPException):
            ask_it(server)
        assert server.again.wait(GUARD_S)
        assert "a fault of the loop" in caplog.text
        assert (server.port, ask_it(server)) == (port, 200)
    # It ends, also while it waits for its next start.
    with Failing() as server:
        with suppress(OSError, http.client.HTTPException):
            ask_it(server)
        server.stop()


def test_a_server_that_cannot_start_says_so():
    class Broken(Failing):
        @asynccontextmanager
        async def beside(self):
            raise RuntimeError("a fault at the start")
            yield

    with pytest.raises(RuntimeError, match="a fault at the start"):
        Broken().start()


def test_an_answer_that_the_browser_has_is_not_sent_again(built):
    with PageServer(
        **SETTINGS, built=built, answers={"incident_picture": lambda _: {"jpeg": "x" * 999}}
    ) as page:
        first, body = ask(page, "/incident_picture.json?id=1")
        again, nothing = ask(
            page, "/incident_picture.json?id=1", headers={"If-None-Match": first.headers["ETag"]}
        )
        other, _ = ask(page, "/incident_picture.json?id=1", headers={"If-None-Match": 'W/"other"'})
    assert (first.status, len(json.loads(body)["jpeg"])) == (200, 999)
    assert (again.status, nothing, again.headers["ETag"]) == (304, b"", first.headers["ETag"])
    assert other.status == 200


def test_pictures_of_incidents_hold_up_neither_each_other_nor_reading(built):
    """A browser has one made at a time; others of the page's answers have their places."""
    may, begun = threading.Event(), threading.Semaphore(0)
    making = []

    def picture(asked):
        making.append(asked["id"])
        begun.release()
        assert may.wait(GUARD_S)
        return {"jpeg": ""}

    answers = {"incident_picture": picture, "robots": lambda _: {"robots": {}}}
    with PageServer(**SETTINGS, built=built, answers=answers) as page, ThreadPoolExecutor(6) as viewers:
        asked = [viewers.submit(ask, page, f"/incident_picture.json?id={i}") for i in range(6)]
        assert begun.acquire(timeout=GUARD_S)
        # Whoever reads something else has an answer meanwhile, more often than there are places in all.
        assert [ask(page, "/robots.json")[0].status for _ in range(20)] == [200] * 20
        assert len(making) == 1
        may.set()
        assert [one.result()[0].status for one in asked] == [200] * 6


def test_a_file_of_the_most_bytes_is_sent_whole(built):
    """It has no content on the disk, so that a test can have it."""

    def download(_asked, folder):
        path = folder / "brake.mcap"
        with path.open("wb") as file:
            file.truncate(MOST_BYTES)
        return path

    with PageServer(**SETTINGS, built=built, downloads={"incident.mcap": download}) as page:
        address = urlsplit(page.url)
        with closing(
            http.client.HTTPConnection(address.hostname or "", address.port, timeout=GUARD_S)
        ) as connection:
            connection.request("GET", "/incident.mcap")
            answer = connection.getresponse()
            assert answer.headers["Content-Length"] == str(MOST_BYTES)
            taken = 0
            while part := answer.read(2**20):
                taken += len(part)
    assert taken == MOST_BYTES
