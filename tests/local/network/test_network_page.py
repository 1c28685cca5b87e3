"""The page in a network: nothing without the password, and the whole page with it, in a browser."""

from __future__ import annotations

import http.client
import ssl
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from argon2 import PasswordHasher

from iort_contract.cloud import IOT
from iort_station.page.password import TRIES, Password
from local.network.certificates import LASTS_S, ServerCertificate
from local.network.servers import Listen
from local.up import network_page
from local.up.network_page import COOKIE, SOCKET, NetworkPage
from local.up.run import shown
from testkit.ports import free_port
from testkit.waiting import GUARD_S, until

ADDRESS = Listen("127.0.0.3", ("127.0.0.3",))
NAMED = Listen("::1", ("::1", "localhost"))
RIGHT = "correct horse battery"
UPGRADE = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Protocol": "mqtt"}


@pytest.fixture
def page(embedded, tmp_path, request) -> Iterator[NetworkPage]:
    listen: Listen = getattr(request, "param", ADDRESS)
    password = Password(tmp_path, PasswordHasher(time_cost=1, memory_cost=8, parallelism=1))
    password.set(RIGHT)
    certificate = ServerCertificate(embedded.authority, tmp_path / "page.pem", listen.hosts)
    certificate.renew()
    port = free_port()
    cloud = replace(embedded.cloud, websocket=f"wss://{listen.at(port)}{SOCKET}")
    with NetworkPage(
        listen,
        port,
        password=password,
        gateway=cloud.endpoint_url or "",
        trusts=ssl.create_default_context(cafile=cloud.ca_bundle),
        context=certificate.context(),
        **shown(cloud),
    ) as page:
        yield page


Answer = tuple[http.client.HTTPResponse, str]


@pytest.fixture
def ask(embedded, page) -> Callable[..., Answer]:
    trusts = ssl.create_default_context(cadata=embedded.cloud.root_ca_pem)

    def request(method: str, path: str, body: str | None = None, **headers: str) -> Answer:
        connection = http.client.HTTPSConnection(ADDRESS.host, page.port, context=trusts, timeout=GUARD_S)
        connection.request(
            method, path, body, {name.replace("_", "-"): value for name, value in headers.items()}
        )
        answer = connection.getresponse()
        told = answer, answer.read().decode(errors="replace")
        connection.close()
        return told

    return request


@pytest.fixture
def log_in(page, ask) -> Callable[..., Answer]:
    def post(password: str = RIGHT, **headers: str) -> Answer:
        origin = {"Origin": page.url.rstrip("/"), **headers}
        form = f"username=iort&password={password.replace(' ', '+')}"
        return ask("POST", "/login", form, **{"Content-Type": "application/x-www-form-urlencoded"}, **origin)

    return post


def cookie_of(answer: http.client.HTTPResponse) -> str:
    return (answer.headers["Set-Cookie"] or "").partition(";")[0]


def test_without_the_password_there_is_the_form_and_nothing_else(page, ask):
    for path in ("/", "/login", "/index.html"):
        answer, body = ask("GET", path)
        assert (answer.status, 'type="password"' in body) == (200, True)
    for method, path in [("GET", "/config.json"), ("GET", "/streams.json?robot=car1"), ("GET", "/page.js")]:
        assert ask(method, path, Cookie=f"{COOKIE}=guess")[0].status == 401
    assert ask("POST", "/key.json", "{}", Origin=page.url.rstrip("/"))[0].status == 401
    assert ask("GET", SOCKET, Origin=page.url.rstrip("/"), **UPGRADE)[0].status == 401


def test_a_cookie_opens_the_page_until_logout_or_another_password(page, ask, log_in, tmp_path):
    answer, _ = log_in()
    assert answer.status == 303
    assert {"Secure", "HttpOnly", "SameSite=Strict", "Path=/"} <= set(
        answer.headers["Set-Cookie"].split("; ")
    )
    cookie = cookie_of(answer)
    assert ask("GET", "/config.json", Cookie=cookie)[0].status == 200
    assert ask("GET", "/logout", Cookie=cookie)[0].status == 303
    assert ask("GET", "/config.json", Cookie=cookie)[0].status == 401
    cookie = cookie_of(log_in()[0])
    assert ask("GET", "/config.json", Cookie=cookie)[0].status == 200
    Password(tmp_path).set("another password")
    assert ask("GET", "/config.json", Cookie=cookie)[0].status == 401


def test_pages_elsewhere_can_neither_log_in_nor_listen(page, ask, log_in):
    for origin in ("https://elsewhere.example", "http://127.0.0.1:8080", "http://localhost", "null"):
        assert log_in(Origin=origin)[0].status == 403
    cookie = cookie_of(log_in()[0])
    for origin in ("https://elsewhere.example", "http://127.0.0.1", f"http://{ADDRESS.host}:{page.port}"):
        assert ask("GET", SOCKET, Cookie=cookie, Origin=origin, **UPGRADE)[0].status == 403
    assert ask("GET", "/config.json", Cookie=cookie, Host="elsewhere.example")[0].status == 403
    # A name of the certificate leads to the one address that the cookie is for.
    assert ask("GET", "/", Host="iort.lab")[0].headers["Location"] == page.url


def test_the_page_takes_over_a_renewed_certificate(page, embedded, tmp_path):
    shown = [ssl.get_server_certificate((ADDRESS.host, page.port)).strip()]
    # As after two months.
    certificate = ServerCertificate(
        embedded.authority, tmp_path / "page.pem", ADDRESS.hosts, renewed_s=LASTS_S
    )
    assert certificate.renew()
    # The first connection after the change tells the server.
    shown += [ssl.get_server_certificate((ADDRESS.host, page.port)).strip() for _ in range(2)]
    assert [one in certificate.path.read_text() for one in shown] == [False, False, True]


def test_guesses_come_to_an_end(ask, log_in):
    assert [log_in(f"guess {i} of many")[0].status for i in range(TRIES)] == [403] * TRIES
    answer, body = log_in()
    assert (answer.status, "Try again in" in body) == (429, True)
    assert 0 < int(answer.headers["Retry-After"]) <= 30


def test_a_password_may_come_in_pieces_but_not_for_ever(page, embedded, monkeypatch):
    trusts = ssl.create_default_context(cadata=embedded.cloud.root_ca_pem)
    body = f"password={RIGHT.replace(' ', '+')}".encode()

    def post(*parts: bytes) -> int:
        connection = http.client.HTTPSConnection(ADDRESS.host, page.port, context=trusts, timeout=GUARD_S)
        connection.putrequest("POST", "/login")
        connection.putheader("Origin", page.url.rstrip("/"))
        connection.putheader("Content-Length", str(len(body)))
        connection.endheaders()
        for part in parts:
            # The server has read what came before.
            time.sleep(0.1)
            connection.send(part)
        status = connection.getresponse().status
        connection.close()
        return status

    assert post(body[:15], body[15:]) == 303
    monkeypatch.setattr(network_page, "_FORM_S", 1.0)
    assert post(body[:15]) == 408


@pytest.mark.parametrize("page", [ADDRESS, NAMED], indirect=True, ids=str)
def test_a_browser_logs_in_listens_and_may_drive(page, open_page):
    tab = open_page(page.url, listening=False, ignore_https_errors=True)
    tab.fill("input[type=password]", "not the password")
    tab.click("button")
    tab.wait_for_selector("text=This is not the password.")
    tab.fill("input[type=password]", RIGHT)
    tab.click("button")
    until(lambda: tab.evaluate("window.iort?.link") == "live", "the page to connect")
    # The key for what moves robots has come with the login.
    assert tab.evaluate("Object.values(localStorage).length") > 0
    told = tab.evaluate("fetch('config.json').then((answer) => answer.json())")
    assert (told["live"], "send" in told["keyed"]) == (IOT, True)
    tab.goto(f"{page.url}logout")
    tab.wait_for_selector("input[type=password]")
