"""Incidents: who is told of them, how often, and what a receiver of the webhook can prove."""

from __future__ import annotations

import importlib.util
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import boto3
import pytest

from functions import incident
from functions.incident import MAILS_AN_HOUR, NOTES, Told, Ways, mail, news
from functions.shared.clients import variables
from functions.shared.incidents import BURST, Announcer
from functions.shared.quotas import HOUR, Quota
from functions.shared.webhooks import PAUSES_S, StoredWebhook, WebhookError
from iort_contract.catalog.environments import IncidentEnvironment
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch
from iort_contract.messages.recorder import KEPT, LOST, NOTIFIED, OVER_BUDGET, STATES, UPLOADED, Incident
from iort_contract.tables import INCIDENT_HOUR, INCIDENT_MAILS, INCIDENTS_TOLD
from iort_contract.topics import RECORD, build_topic
from iort_contract.webhook import (
    DELIVERY,
    SIGNATURE,
    TIMESTAMP,
    Webhook,
    check_url,
    headers,
    stored_webhook,
    webhook_parameter,
)
from testkit.dynamodb import ROBOTS
from testkit.waiting import GUARD_S
from tests.unit.functions.summarizing import Stream, batch

NOW_S, T_US = 1_700_000_000, 1_700_000_000_000_000
ONE = Incident(
    "0123456789abcdef",
    "hardbrake",
    T_US - 30_000_000,
    T_US,
    KEPT,
    "current_input < -15",
    "current_input = -17.5",
    key="robots/car/incidents/0123.mcap",
)
TOPIC_OF_CAR = build_topic(RECORD, "car", INCIDENT_STREAM)


def event(state=KEPT, *, topic=TOPIC_OF_CAR, **changes):
    """The event that Lambda 2 makes of a sample."""
    return {"topic": topic, "t": T_US, "incident": {**ONE.sample(), "state": state, **changes}}


class Mailbox(list):
    def __call__(self, subject, text):
        self.append((subject, text))


class FakeWebhook:
    """A webhook whose receiver fails as often as ``failures`` says."""

    def __init__(self, failures=0, *, exists=True):
        self.failures, self.exists, self.taken = failures, exists, []

    def stored(self):
        return self.exists

    def deliver(self, body, delivery):
        if self.failures:
            self.failures -= 1
            raise WebhookError("the webhook answered 500")
        self.taken.append((json.loads(body), delivery))
        return 204


@pytest.fixture
def ways(dynamodb):
    """How the robots car and other are told of, with a mailbox and a webhook."""
    for robot in ("car", "other"):
        dynamodb.put_item(TableName=ROBOTS, Item={"robot": {"S": robot}})
    quota = Quota(
        dynamodb, table=ROBOTS, named=(INCIDENT_HOUR, INCIDENT_MAILS), period=HOUR, most=MAILS_AN_HOUR
    )
    return lambda mailbox, webhook: Ways(Told(dynamodb, ROBOTS), quota, mailbox, webhook)


def test_each_state_of_an_incident_is_told_once(ways):
    mailbox, webhook = Mailbox(), FakeWebhook()
    told = ways(mailbox, webhook)
    for _ in range(3):
        for state in STATES:
            told.tell(event(state), NOW_S)
    assert [one["state"] for one, _ in webhook.taken] == list(STATES)
    assert len({delivery for _, delivery in webhook.taken}) == len(STATES)
    body, _ = webhook.taken[0]
    assert body == {"namespace": "iort", "robot": "car", "t_us": T_US, **ONE.sample()}
    # Whoever is mailed need not hear that the data arrived.
    assert [subject.split(", ", 2)[2] for subject, _ in mailbox] == [
        "kept",
        "seen",
        "over the budget of its trigger",
        "lost",
    ]


def test_a_mail_says_what_happened_and_how_to_get_the_file():
    subject, text = mail(news(event()))
    assert subject == "iort: car, hardbrake, kept"
    assert "2023-11-14 22:12:50 to 2023-11-14 22:13:20 UTC" in text
    assert "current_input < -15" in text
    assert "current_input = -17.5" in text
    (command,) = (line.partition(": ")[2] for line in text.splitlines() if "incidents get" in line)
    assert command == "iort incidents get 0123456789abcdef --robot car"
    assert "incidents get" not in mail(news(event(LOST)))[1]
    # A robot may say any time.
    assert mail(news(event(from_us=2**62, to_us=-(2**62))))


def test_a_webhook_that_cannot_be_read_holds_up_no_mail(ways, monkeypatch):
    mailbox, webhook = Mailbox(), FakeWebhook()

    def broken():
        raise WebhookError("the parameter does not hold a webhook")

    with monkeypatch.context() as patch:
        patch.setattr(webhook, "stored", broken)
        for _ in range(2):
            with pytest.raises(WebhookError):
                ways(mailbox, webhook).tell(event(), NOW_S)
    assert len(mailbox) == 1
    ways(mailbox, webhook).tell(event(), NOW_S)
    assert (len(mailbox), len(webhook.taken)) == (1, 1)


def test_nobody_is_told_without_mails_and_webhook_and_nothing_is_read(ways):
    told = ways(None, FakeWebhook(exists=False))
    object.__setattr__(told, "told", None)
    told.tell(event(), NOW_S)


def test_a_removed_robot_tells_nobody_and_gets_no_row(ways, dynamodb):
    mailbox, webhook = Mailbox(), FakeWebhook()
    ways(mailbox, webhook).tell(event(topic=build_topic(RECORD, "gone", INCIDENT_STREAM)), NOW_S)
    assert (mailbox, webhook.taken) == ([], [])
    assert "Item" not in dynamodb.get_item(TableName=ROBOTS, Key={"robot": {"S": "gone"}})


def test_a_failing_receiver_gets_it_again_and_the_mail_is_not_repeated(ways, capsys):
    mailbox, webhook = Mailbox(), FakeWebhook(failures=2)
    told = ways(mailbox, webhook)
    for _ in range(2):
        with pytest.raises(WebhookError, match="500"):
            told.tell(event(), NOW_S)
    told.tell(event(), NOW_S)
    told.tell(event(), NOW_S)
    assert (len(mailbox), len(webhook.taken)) == (1, 1)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [sum(line.get(name, 0) for line in lines) for name in ("WebhooksFailed", "WebhooksSent")] == [2, 1]


def test_mails_of_a_robot_are_bounded_and_its_webhooks_and_notes_too(ways, dynamodb, capsys):
    mailbox, webhook = Mailbox(), FakeWebhook()
    told = ways(mailbox, webhook)
    for n in range(MAILS_AN_HOUR + 20):
        told.tell(event(id=f"{n:016x}"), NOW_S + n)
    assert (len(mailbox), len(webhook.taken)) == (MAILS_AN_HOUR, MAILS_AN_HOUR + 20)
    assert (
        sum(json.loads(line).get("IncidentsHeld", 0) for line in capsys.readouterr().out.splitlines()) == 20
    )
    row = dynamodb.get_item(TableName=ROBOTS, Key={"robot": {"S": "car"}})["Item"]
    assert len(row[INCIDENTS_TOLD]["SS"]) == NOTES
    # The newest are still known, and another robot's incidents of the same id are other incidents.
    told.tell(event(id=f"{MAILS_AN_HOUR + 19:016x}"), NOW_S + 100)
    assert len(webhook.taken) == MAILS_AN_HOUR + 20
    told.tell(event(topic=build_topic(RECORD, "other", INCIDENT_STREAM)), NOW_S)
    assert len(webhook.taken) == MAILS_AN_HOUR + 21


@pytest.mark.parametrize(
    "bad",
    [
        {},
        event("unknown"),
        event(id="x"),
        {**event(), "t": "now"},
        {**event(), "incident": None},
        event(topic=build_topic(RECORD, "car", "vesc")),
    ],
)
def test_another_event_goes_to_the_quarantine(bad, invoke, rejected, aws, monkeypatch):
    for name, value in (("ALARM_TOPIC", "t"), ("WEBHOOK_PARAMETER", "/iort/webhook")):
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("INCIDENT_MAILS", "true")
    monkeypatch.setenv("EMBEDDED", "false")
    with pytest.raises(ContractError):
        news(bad)
    invoke(incident.handler, bad)
    (entry,) = rejected()
    assert entry.source == "function incident"
    assert json.loads(entry.payload) == bad


# --- the webhook -------------------------------------------------------------------------------------


class Receiver(BaseHTTPRequestHandler):
    """Keeps what it is sent, and answers with the next of ``statuses``."""

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.taken.append((self.path, self.headers, body))
        status = self.server.statuses.pop(0) if self.server.statuses else 204
        self.send_response(status)
        if status == 302:
            self.send_header("Location", "/elsewhere")
        self.end_headers()

    def log_message(self, *_): ...


@pytest.fixture
def receiver(socket_enabled):
    server = ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    server.taken, server.statuses = [], []
    server.url = f"http://127.0.0.1:{server.server_port}/hook?robot=all"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def example():
    """The receiver's side in docs/examples."""
    path = Path(__file__).parents[3] / "docs" / "examples" / "webhook_receiver.py"
    spec = importlib.util.spec_from_file_location("webhook_receiver", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Clock:
    def __init__(self):
        self.now_s, self.pauses = float(NOW_S), []

    def __call__(self):
        return self.now_s

    def pause(self, seconds):
        self.pauses.append(seconds)
        self.now_s += seconds


def stored(url, clock, *, plain=True):
    boto3.client("ssm").put_parameter(
        Name=webhook_parameter(), Value=Webhook(url, "s3cret").text(), Type="SecureString", Overwrite=True
    )
    webhook = StoredWebhook(webhook_parameter(), plain=plain, clock=clock, pause=clock.pause)
    assert webhook.stored()
    return webhook


def test_a_receiver_can_verify_a_message_and_refuses_a_changed_or_repeated_one(example):
    body = news(event(UPLOADED)).body
    sent = headers("s3cret", body, NOW_S, "car-1-uploaded")
    assert example.verified("s3cret", sent, body, now_s=NOW_S + 299)
    assert not example.verified("s3cret", sent, body, now_s=NOW_S + 301)
    assert not example.verified("s3cret", sent, body, now_s=NOW_S - 301)
    assert not example.verified("another", sent, body, now_s=NOW_S)
    assert not example.verified("s3cret", sent, body + b" ", now_s=NOW_S)
    assert not example.verified("s3cret", {**sent, TIMESTAMP: str(NOW_S + 1)}, body, now_s=NOW_S)
    for broken in ({}, {**sent, TIMESTAMP: "now"}, {**sent, SIGNATURE: "v1=é"}):
        assert not example.verified("s3cret", broken, body, now_s=NOW_S)


def test_it_sends_again_after_pauses_each_with_its_own_timestamp(receiver, aws, example):
    clock = Clock()
    receiver.statuses = [500, 302]
    assert stored(receiver.url, clock).deliver(b"{}", "car-1-kept") == 204
    assert clock.pauses == list(PAUSES_S)
    assert [path for path, *_ in receiver.taken] == ["/hook?robot=all"] * 3, "a redirect is not followed"
    for (_, sent, body), late in zip(receiver.taken, (0, 1, 5), strict=True):
        assert sent[TIMESTAMP] == str(NOW_S + late)
        assert sent[DELIVERY] == "car-1-kept"
        assert example.verified("s3cret", sent, body, now_s=NOW_S)


def test_it_gives_up_after_three_tries_and_says_why_without_secrets(receiver, aws):
    receiver.statuses = [500] * 3
    with pytest.raises(WebhookError) as failed:
        stored(receiver.url, Clock()).deliver(b"{}", "x")
    assert str(failed.value) == "the webhook at 127.0.0.1 answered 500"
    receiver.shutdown()
    receiver.server_close()
    with pytest.raises(WebhookError, match="did not answer: ConnectionRefusedError"):
        stored(receiver.url, Clock()).deliver(b"{}", "x")


def test_a_receiver_that_drips_its_answer_has_one_deadline_for_all_of_it(aws, socket_enabled):
    """Each byte comes in time, but the answer takes far longer."""
    hung_up = threading.Event()

    class Dripping(BaseHTTPRequestHandler):
        def handle(self):
            self.connection.recv(65_536)
            self.connection.settimeout(0.05)
            for byte in b"HTTP/1.1 200 OK\r\nX-Slow: " + b"x" * 60 + b"\r\n\r\n":
                try:
                    self.connection.sendall(bytes([byte]))
                    ended = self.connection.recv(1) == b""
                except TimeoutError:
                    continue
                except OSError:
                    ended = True
                if ended:
                    hung_up.set()
                    return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Dripping)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        clock = Clock()
        stored(f"http://127.0.0.1:{server.server_port}/", clock)
        webhook = StoredWebhook(
            webhook_parameter(), plain=True, timeout_s=0.5, clock=clock, pause=clock.pause
        )
        webhook.stored()
        with pytest.raises(WebhookError, match=r"did not answer within 0\.5 s"):
            webhook.deliver(b"{}", "x", tries=1)
        assert hung_up.wait(GUARD_S), "the connection stays open"
    finally:
        server.shutdown()
        server.server_close()


def test_a_webhook_that_is_stored_later_is_used_at_once_and_a_removed_one_no_more(receiver, aws):
    clock = Clock()
    webhook = StoredWebhook(webhook_parameter(), plain=True, clock=clock, pause=clock.pause)
    assert not webhook.stored()
    with pytest.raises(WebhookError, match="iort webhook set"):
        webhook.deliver(b"{}", "x")
    stored(receiver.url, clock)
    assert webhook.stored()
    boto3.client("ssm").delete_parameter(Name=webhook_parameter())
    assert not webhook.stored()


def test_only_https_is_taken_except_on_this_machine_by_the_embedded_cloud(receiver, aws):
    with pytest.raises(WebhookError, match="https://"):
        stored(receiver.url, Clock(), plain=False)
    assert check_url("https://lab.example.org/hook?a=b") == "https://lab.example.org/hook?a=b"
    for bad in (
        *("", 5, "ftp://a/", "http://example.org/", "https://", "https://user:word@example.org/"),
        *(
            "https://a/#x",
            "https://a/\n",
            "https://a b/",
            "https://[::1/",
            "https://a:b/",
            f"https://a/{'x' * 1000}",
        ),
    ):
        with pytest.raises(ContractError):
            check_url(bad, plain=True)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"url": "https://a/"}', '{"url": "https://a/", "secret": ""}']
)
def test_another_parameter_is_refused_without_its_content(text):
    with pytest.raises(ContractError, match="iort webhook set"):
        stored_webhook(text)
    assert "s3cret" not in repr(Webhook("https://a/", "s3cret"))


def test_the_operators_test_message_answers_with_the_receivers_status(receiver, aws, invoke, monkeypatch):
    incident._ways.cache_clear()
    variables.cache_clear()
    for name, value in (
        *(("ALARM_TOPIC", "t"), ("WEBHOOK_PARAMETER", webhook_parameter())),
        *(("INCIDENT_MAILS", "true"), ("EMBEDDED", "true")),
    ):
        monkeypatch.setenv(name, value)
    stored(receiver.url, Clock())
    assert invoke(incident.handler, {"test": True}) == {"status": 204}
    receiver.statuses = [403]
    with pytest.raises(WebhookError, match="answered 403"):
        invoke(incident.handler, {"test": True})
    assert [json.loads(body)["test"] for *_, body in receiver.taken] == [True, True]


def test_the_environment_is_read_as_it_was_written():
    written = IncidentEnvironment("iort", "robots", "topic", "queue", "/iort/webhook", True, False)
    assert IncidentEnvironment.read(written.variables()) == written


# --- Lambda 2 gives samples to the function ------------------------------------------------------------


class Lambda:
    def __init__(self):
        self.events, self.failing = [], False

    def invoke(self, **asked):
        if self.failing:
            from botocore.exceptions import ClientError

            raise ClientError({"Error": {"Code": "TooManyRequestsException"}}, "Invoke")
        assert (asked["FunctionName"], asked["InvocationType"]) == ("incident", "Event")
        self.events.append(json.loads(asked["Payload"]))


def samples(*states, seq=0):
    """A batch of the stream incidents."""
    columns = {name: [value] * len(states) for name, value in ONE.sample().items()}
    times = [T_US + place for place in range(len(states))]
    return Batch("aaaaaaaa", seq, times, {**columns, "state": list(states)})


@pytest.fixture
def announced():
    client = Lambda()
    announcer = Announcer(lambda: client, "incident", clock=lambda: NOW_S)
    client.announce = announcer.announce
    return client


def test_a_function_that_cannot_be_called_holds_up_no_samples(monkeypatch):
    from botocore.exceptions import ConnectTimeoutError

    from functions.shared import summary

    calls = []

    class Hanging:
        def invoke(self, **call):
            calls.append(call)
            raise ConnectTimeoutError(endpoint_url="lambda")

    batches = [samples(KEPT) for _ in range(20)]
    assert Announcer(Hanging, "incident").announce(TOPIC_OF_CAR, batches) == batches
    assert len(calls) == 1
    # One call ends long before Lambda 2 must.
    monkeypatch.setattr(summary, "connect", lambda _service, config: config)
    config = summary.caller.__wrapped__()
    assert (config.connect_timeout + config.read_timeout) * config.retries["total_max_attempts"] < 20


def test_lambda_2_announces_the_samples_of_incidents_alone(announced):
    from functions.shared.summary import process

    stream = Stream()
    records = [
        *stream.store(samples(KEPT, UPLOADED), topic=TOPIC_OF_CAR),
        *stream.store(batch(T_US, 5)),
    ]
    answer = process({"Records": records}, stream.tables, stream.refuse, announce=announced.announce)
    assert answer == {"batchItemFailures": []}
    assert [news(one).incident.state for one in announced.events] == [KEPT, UPLOADED]
    assert [one["t"] for one in announced.events] == [T_US, T_US + 1]
    # What it cannot give comes again.
    announced.failing = True
    again = process({"Records": records}, stream.tables, stream.refuse, announce=announced.announce)
    assert again == {"batchItemFailures": [{"itemIdentifier": records[0]["dynamodb"]["SequenceNumber"]}]}
    # Batches that were recorded long ago, and put into the table by hand, are no news.
    announced.failing, announced.events = False, []
    late = process(
        {"Records": records}, stream.tables, stream.refuse, announce=announced.announce, news_since_ms=2**53
    )
    assert (late, announced.events) == ({"batchItemFailures": []}, [])


def test_a_hostile_robot_makes_neither_many_calls_nor_large_ones(announced, caplog):
    flood = samples(*[KEPT] * 1000)
    flood.columns["why"][:] = ["x" * 10_000] * 1000
    assert announced.announce(TOPIC_OF_CAR, [flood]) == []
    assert len(announced.events) == BURST
    assert "has more incidents than are told of" in caplog.text
    assert max(len(json.dumps(one)) for one in announced.events) < 2000
    announced.announce(build_topic(RECORD, "other", INCIDENT_STREAM), [samples(NOTIFIED, OVER_BUDGET, LOST)])
    assert len(announced.events) == BURST + 3
