"""The page's web server, over loopback: its files, its rejections, and the secrets that it never sends."""

from __future__ import annotations

import asyncio
import gc
import gzip
import http.client
import json
import socket
import stat
import threading
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, closing, suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from aiohttp import web
from aiohttp.web_protocol import RequestHandler

from iort_station.errors import StationError, UsageError
from iort_station.page import invitations
from iort_station.page.background import BackgroundServer
from iort_station.page.page import BUILT, config, load_track
from iort_station.page.server import PageServer, on_loopback
from testkit.ports import free_port

TOLD: dict[str, Any] = {
    "namespace": "iort",
    "subscribe_key": "sub-c-1",
    "origin": "127.0.0.1:9",
    "tls": False,
}


@pytest.fixture
def built(tmp_path: Path) -> Path:
    folder = tmp_path / "web"
    folder.mkdir()
    (folder / "index.html").write_text("<!doctype html><title>page</title>")
    (folder / "page.js").write_text("'use strict'")
    (folder / "style.css").write_text("body {}")
    (folder / "page.bin").write_text("no type of its own: not served")
    (tmp_path / "secret.json").write_text("{}")
    return folder


def ask(
    page: PageServer,
    path: str,
    method: str = "GET",
    headers: dict[str, str] | None = None,
    body: str | None = None,
) -> tuple[http.client.HTTPResponse, bytes]:
    address = urlsplit(page.url)
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=60)
    connection.request(method, path, body and body.encode(errors="surrogatepass"), headers or {})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer, content


def post(page: PageServer, name: str, body: str, kind: str = "application/json", **more: str) -> Any:
    """Ask for an action from the page's own origin."""
    given = {name.replace("_", "-"): value for name, value in more.items()}
    headers = {"Host": "localhost", "Origin": "http://localhost", "Content-Type": kind, **given}
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
def test_files_come_with_their_type_and_the_policy(built: Path, path: str, kind: str) -> None:
    with PageServer(**TOLD, built=built) as page:
        answer, body = ask(page, path)
        packed, packed_body = ask(page, path, headers={"Accept-Encoding": "gzip, br"})
        head, no_body = ask(page, path, "HEAD")
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
    [
        "/nothing",
        "/.",
        "/..",
        "/../secret.json",
        "/%2e%2e/secret.json",
        "//etc/passwd",
        "/page.js/",
        "/page.bin",
    ],
)
def test_other_paths_are_not_served(built: Path, path: str) -> None:
    with PageServer(**TOLD, built=built) as page:
        answer, body = ask(page, path)
    assert answer.status == 404
    assert b"<" not in body
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]


def test_a_cached_file_is_not_sent_again(built: Path) -> None:
    with PageServer(**TOLD, built=built) as page:
        etag = ask(page, "/page.js")[0].headers["ETag"]
        again, body = ask(page, "/page.js", headers={"If-None-Match": etag, "Accept-Encoding": "gzip"})
        other, _ = ask(page, "/style.css", headers={"If-None-Match": etag})
    assert (again.status, again.headers["ETag"], body) == (304, etag, b"")
    assert "default-src 'none'" in again.headers["Content-Security-Policy"]
    assert other.status == 200


def test_a_slow_answer_delays_neither_a_file_nor_the_shutdown(built: Path) -> None:
    asked, done = threading.Event(), threading.Event()

    def slow(_asked: Mapping[str, str]) -> dict[str, Any]:
        asked.set()
        done.wait()
        return {}

    try:
        with (
            PageServer(**TOLD, built=built, answers={"slow": slow}) as page,
            socket.create_connection((page.host, page.port)) as waiting,
        ):
            waiting.sendall(b"GET /slow.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert asked.wait(60)
            assert ask(page, "/page.js")[0].status == 200
            page.stop()
            assert waiting.recv(1) == b""
    finally:
        done.set()


def test_the_configuration_has_the_track_of_a_file(built: Path, tmp_path: Path) -> None:
    file = tmp_path / "track.csv"
    file.write_text("# x_m, y_m, w_right_m, w_left_m\n0,0,1,2\n4,0,1,2\n4,3,1,2\n0,3,1,2\n")
    with PageServer(**TOLD, built=built, track=load_track(file)) as page:
        told = json.loads(ask(page, "/config.json")[1])
    assert told["track"] == {
        "x_m": [0, 4, 4, 0], "y_m": [0, 0, 3, 3], "w_right_m": [1, 1, 1, 1], "w_left_m": [2, 2, 2, 2],
    }  # fmt: skip
    file.write_text("0,0\n")
    with pytest.raises(StationError, match=r"track.csv: line 1 must be the four numbers"):
        load_track(file)


def test_a_malformed_request_is_answered_without_a_traceback(
    built: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with PageServer(**TOLD, built=built) as page:
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
def test_gzip_is_sent_only_if_it_is_accepted(built: Path, accepted: str, *, packed: bool) -> None:
    with PageServer(**TOLD, built=built) as page:
        answer, _ = ask(page, "/page.js", headers={"Accept-Encoding": accepted})
    assert (answer.headers["Content-Encoding"] == "gzip") is packed


def test_other_methods_are_rejected(built: Path) -> None:
    with PageServer(**TOLD, built=built) as page:
        assert ask(page, "/", "POST")[0].status == 405


def test_an_action_needs_a_post_of_json_from_the_page_itself(built: Path) -> None:
    """A page elsewhere has neither this origin nor the key, and a form cannot send this type."""
    done: list[Mapping[str, str]] = []

    def act(asked: Mapping[str, str]) -> dict[str, Any]:
        done.append(asked)
        if not asked:
            raise StationError("nothing was asked")
        return {"done": True}

    with PageServer(**TOLD, actions={"act": act}, open_actions={"note": act}, built=built) as page:
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


def test_the_key_comes_once_for_each_invitation_and_is_in_no_file(built: Path) -> None:
    shown: list[str] = []

    def token(address: str) -> str:
        return json.dumps({"token": address.rpartition("=")[2]})

    with PageServer(**TOLD, actions={"act": lambda _: {}}, admitted=shown.append, built=built) as page:
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
        told = ask(page, "/config.json")[1].decode()
    assert answer["key"] not in told
    assert json.loads(told)["keyed"] == ["act"]
    with PageServer(**TOLD, open_actions={"act": lambda _: {}}, built=built) as page:
        assert page.invitation() == f"{page.url}#/"


@pytest.mark.parametrize("place", ["pages", "a" * 120])
def test_a_command_gives_another_browser_the_key(built: Path, tmp_path: Path, place: str) -> None:
    folder = tmp_path / place
    keyed: dict[str, Any] = {"actions": {"act": lambda _: {}}, "built": built, "invitations": folder}
    with PageServer(**TOLD, **keyed) as page:
        assert json.loads(ask(page, "/config.json")[1])["invite"] == "iort invite"
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
        with PageServer(**TOLD, **keyed) as other:
            assert [one.url for one in invitations.served(folder)] == sorted([page.url, other.url])
            with pytest.raises(UsageError, match=r"several pages are served: .*--port"):
                invitations.invite(folder)
            assert invitations.invite(folder, other.port)[1].startswith(other.url)
        with pytest.raises(UsageError, match=f"got 1; there is {page.url}"):
            invitations.invite(folder, 1)
    with pytest.raises(StationError, match="you serve no page"):
        invitations.invite(folder)


def test_the_socket_of_a_killed_server_is_no_page(built: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as killed:
        port = free_port()
        killed.bind(str(tmp_path / f"{port}.sock"))
    assert not invitations.served(tmp_path)
    keyed: Any = {"act": lambda _: {}}
    with PageServer(**TOLD, actions=keyed, built=built, invitations=tmp_path, port=port) as page:
        assert [one.url for one in invitations.served(tmp_path)] == [page.url]


def test_a_page_without_a_folder_for_invitations_is_served(
    built: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    keyed: Any = {"act": lambda _: {}}
    with PageServer(**TOLD, actions=keyed, built=built, invitations=tmp_path / "file" / "pages") as page:
        assert ask(page, "/page.js")[0].status == 200
    assert "`iort invite` does not know this page" in caplog.text


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_a_server_on_loopback_may_move_a_robot(host: str) -> None:
    assert on_loopback(host)


@pytest.mark.parametrize("host", ["", "0.0.0.0", "::", "192.168.1.7", "lab.example", "127.0.0.1.example"])
def test_a_server_that_others_reach_may_not_move_a_robot(host: str) -> None:
    assert not on_loopback(host)


def test_without_pubnub_the_page_may_connect_to_the_broker_only(built: Path) -> None:
    broker = "wss://abc-ats.iot.eu-west-1.amazonaws.com"
    drive: Any = {"drive": lambda _asked: {}}
    with PageServer(namespace="iort", live="iot", broker=broker, actions=drive, built=built) as page:
        answer, body = ask(page, "/config.json")
    assert f"connect-src 'self' {broker};" in answer.headers["Content-Security-Policy"]
    told = json.loads(body)
    assert (told["live"], told["drivers"], told["subscribe_key"]) == ("iot", True, "")


def test_the_page_receives_only_its_pubnub_settings(built: Path) -> None:
    vehicles = {"car-1": {"speed_to_erpm_gain": 4614.0}}
    with PageServer(**TOLD, vehicles=vehicles, built=built) as page:
        told = json.loads(ask(page, "/config.json")[1])
    nothing: dict[str, Any] = {"actions": [], "keyed": [], "invite": "", "track": None}
    nothing |= {"live": "pubnub", "drivers": False, "identity": None}
    assert told == {**TOLD, "vehicles": vehicles, "token": "", "answers": False, **nothing}


def test_an_answer_has_null_for_nan_and_infinity(built: Path) -> None:
    answered = {"mean": [1.5, float("inf"), None], "of": {"x": float("nan")}, "n": 3}
    with PageServer(**TOLD, answers={"history": lambda _asked: answered}, built=built) as page:
        answer, body = ask(page, "/history.json")
    assert answer.status == 200
    assert json.loads(body) == {"mean": [1.5, None, None], "of": {"x": None}, "n": 3}


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
def test_invalid_page_settings_are_rejected(change: dict[str, Any], says: str) -> None:
    with pytest.raises(StationError, match=says):
        config(**{**TOLD, **change})


def test_a_busy_port_raises_an_error(built: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(StationError, match=f"port {port}: the port is in use"):
            PageServer(**TOLD, port=port, built=built).start()


@pytest.mark.parametrize("port", [-1, 70_000])
def test_an_invalid_port_raises_an_error(built: Path, port: int) -> None:
    with pytest.raises(StationError, match="cannot serve the page"):
        PageServer(**TOLD, port=port, built=built).start()


def test_an_error_explains_how_to_build_the_page(tmp_path: Path) -> None:
    with pytest.raises(StationError, match="make setup"):
        PageServer(**TOLD, built=tmp_path)


def test_the_port_is_free_after_the_shutdown(built: Path) -> None:
    port = free_port()
    with PageServer(**TOLD, built=built, port=port) as page:
        ask(page, "/")
    with PageServer(**TOLD, built=built, port=port) as page:
        assert page.port == port
        assert ask(page, "/")[0].status == 200


def test_a_silent_connection_does_not_delay_the_shutdown(built: Path) -> None:
    page = PageServer(**TOLD, built=built).start()
    with socket.create_connection(("127.0.0.1", page.port)):
        page.stop()
        page.stop()


@pytest.mark.skipif(not socket.has_ipv6, reason="this machine has no IPv6")
def test_the_server_supports_ipv6(built: Path) -> None:
    try:
        page = PageServer(**TOLD, built=built, host="::1").start()
    except StationError as error:
        pytest.skip(f"this machine has no IPv6 loopback: {error}")
    try:
        assert page.url == f"http://[::1]:{page.port}/"
        assert ask(page, "/")[0].status == 200
    finally:
        page.stop()


@pytest.mark.parametrize(
    "path",
    ["/", "/page.js", "/config.json", "/double.json?n=1", "/no", "http://elsewhere/page.js"],
)
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_every_path_rejects_a_foreign_host_name(built: Path, path: str, host: str) -> None:
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
    known = 404 if path in {"/no", "http://elsewhere/page.js"} else 200
    ours = ("localhost", "LOCALHOST:8080", "127.0.0.1", "[::1]:80", "192.168.1.7:8080", "lab.example:80")
    with PageServer(**TOLD, built=built, answers=answers, host=host, names=["Lab.example"]) as page:
        for name in others:
            answer, body = ask(page, path, headers={"Host": name})
            assert (answer.status, TOLD["subscribe_key"].encode() in body) == (403, False), name
            assert ask(page, path, "HEAD", headers={"Host": name})[0].status == 403
        for name in ours:
            assert ask(page, path, headers={"Host": name})[0].status == known, name


def test_a_failed_answer_is_json_with_the_error(built: Path) -> None:
    def answer(asked: Mapping[str, str]) -> dict[str, Any]:
        if "n" not in asked:
            raise StationError("the request names no n")
        return {"twice": 2 * int(asked["n"])}

    with PageServer(**TOLD, built=built, answers={"double": answer}) as page:
        good, body = ask(page, "/double.json?n=21")
        bad, reason = ask(page, "/double.json")
        told = json.loads(ask(page, "/config.json")[1])
    assert (good.status, json.loads(body)) == (200, {"twice": 42})
    assert (bad.status, json.loads(reason)) == (400, {"error": "the request names no n"})
    assert told["answers"] is True


def test_the_pubnub_sdk_is_served_unmodified_with_its_licence() -> None:
    modules = BUILT.parents[3] / "node_modules" / "pubnub"
    if not (BUILT / "index.html").is_file():
        pytest.skip("the live page is not built: npm run build")
    published = (modules / "dist" / "web" / "pubnub.min.js").read_bytes()
    assert (BUILT / "pubnub.min.js").read_bytes() == published
    assert (modules / "LICENSE").read_text().strip() in (BUILT / "licences.txt").read_text()


class Failing(BackgroundServer):
    """Its loop and its look for silent connections fail once each, at the second time."""

    def __init__(self) -> None:
        super().__init__("127.0.0.1", 0, idle_s=30.0)
        self.starts, self.looks = 0, 0
        self.fail, self.again, self.looked = asyncio.Event(), threading.Event(), threading.Event()

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        self.fail.set()
        return web.Response()

    @asynccontextmanager
    async def beside(self) -> AsyncIterator[None]:
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

    async def pause(self, seconds: float) -> None:
        self.looks += 1
        if self.looks == 1:
            raise RuntimeError("a fault of the look")
        self.looked.set()
        await super().pause(seconds)


def test_each_task_of_a_server_goes_on_after_an_unexpected_exception(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def ask_it(server: Failing) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        with closing(connection):
            connection.request("GET", "/")
            return connection.getresponse().status

    with Failing() as server:
        port = server.port
        assert server.looked.wait(60)
        assert "Failing's closing of silent connections has failed" in caplog.text
        with suppress(OSError, http.client.HTTPException):
            ask_it(server)
        assert server.again.wait(60)
        assert "a fault of the loop" in caplog.text
        assert (server.port, ask_it(server)) == (port, 200)
    # It ends, also while it waits for its next start.
    with Failing() as server:
        with suppress(OSError, http.client.HTTPException):
            ask_it(server)
        server.stop()


def test_a_server_that_cannot_start_says_so() -> None:
    class Broken(Failing):
        @asynccontextmanager
        async def beside(self) -> AsyncIterator[None]:
            raise RuntimeError("a fault at the start")
            yield

    with pytest.raises(RuntimeError, match="a fault at the start"):
        Broken().start()


def test_a_server_forgets_connections_that_have_ended() -> None:
    class Plain(BackgroundServer):
        async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
            return web.Response()

    def connections() -> int:
        gc.collect()
        return sum(isinstance(one, RequestHandler) for one in gc.get_objects())

    with Plain("127.0.0.1", 0) as server:
        before = connections()
        for _ in range(20):
            connection = http.client.HTTPConnection("127.0.0.1", server.port)
            with closing(connection):
                connection.request("GET", "/", headers={"Connection": "close"})
                connection.getresponse().read()
        assert connections() - before < 10
