"""The server of the Model Context Protocol, by the SDK's own client and by clients that break its rules."""

from __future__ import annotations

import json
import subprocess
import sys
import threading

import anyio
import pytest
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from iort_contract.messages.batch import Batch
from iort_station.errors import StationError
from iort_station.mcp import AT_ONCE, MOST_LINE_BYTES, WAITING, documents, server
from local.deployment import ROOT
from testkit.waiting import GUARD_S
from tests.unit.station.data.test_queries import START, FakeCloud, cloud_of, ride
from tests.unit.station.test_inquiries import iso

TOOLS = {"robots", "streams", "query", "runs", "findings", "incidents", "audit", "errors", "cost"}
RANGE = {"start": iso(START), "end": iso(START + 1_000_000)}
# A server process as the command starts it, over a recording in memory.
SERVER = """
import anyio
from iort_station.mcp import serve
from tests.unit.station.data.test_queries import cloud_of, ride
print("stray output")
anyio.run(serve, cloud_of(*ride()))
"""


def asked(cloud, work):
    """What ``work`` returns of a client of the server over a cloud."""

    async def run():
        async with Client(server(cloud)) as client:
            return await work(client)

    return anyio.run(run)


def test_every_tool_only_reads_and_says_so():
    tools = asked(cloud_of(*ride()), Client.list_tools).tools
    assert {tool.name for tool in tools} == TOOLS
    for tool in tools:
        assert tool.annotations.read_only_hint
        assert not tool.annotations.destructive_hint
        assert tool.description


def test_a_tool_answers_by_text_and_by_structure():
    async def work(client):
        return await client.call_tool(
            "query", {"robot": "car", "stream": "vesc", **RANGE, "statistics": ["mean"], "fields": ["speed"]}
        )

    answer = asked(cloud_of(*ride()), work)
    assert not answer.is_error
    assert json.loads(answer.content[0].text) == answer.structured_content
    (group,) = answer.structured_content["groups"]
    assert (group["samples"], group["figures"][0]["value"], group["figures"][0]["unit"]) == (50, 24.5, "erpm")


def test_the_documentation_is_there_to_read():
    async def work(client):
        listed = (await client.list_resources()).resources
        page = await client.read_resource("docs://how-to/mcp.md")
        with pytest.raises(Exception, match=r"docs://\.\./README\.md"):
            await client.read_resource("docs://../README.md")
        return listed, page

    listed, page = asked(cloud_of(), work)
    assert {str(one.uri) for one in listed} == {f"docs://{name}" for name in documents()}
    assert page.contents[0].text == (ROOT / "docs" / "how-to" / "mcp.md").read_text()


def test_a_mean_that_no_number_holds_is_null_or_an_error():
    async def work(client):
        asking = {"robot": "car", "stream": "vesc", **RANGE}
        rows = await client.call_tool("query", {**asking, "every": "1s"})
        return rows, await client.call_tool("query", {**asking, "statistics": ["mean"]})

    rows, mean = asked(cloud_of(Batch("0badcafe", 0, [START, START + 1], {"speed": [1e308, 1e308]})), work)
    assert rows.structured_content["columns"][0]["values"] == [None]
    assert "beyond the numbers that 64 bits can hold" in mean.structured_content["error"]


def test_an_error_says_what_to_do_and_marks_what_a_robot_wrote():
    async def work(client):
        return [
            await client.call_tool("query", {"robot": "card", "stream": "vesc"}),
            await client.call_tool("query", {"robot": "car", "stream": "vesc", "start": "yesterday"}),
            await client.call_tool("stop", {"robot": "car"}),
        ]

    unknown, wrong, missing = asked(cloud_of(*ride()), work)
    assert unknown.is_error
    assert unknown.structured_content == {
        "error": "robot card is not registered; `nearest` has names like it",
        "nearest": [{"robot_text": "car"}],
    }
    assert "time must be now, -10m" in wrong.structured_content["error"]
    assert missing.is_error
    assert "stop" in missing.content[0].text


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"robot": "x" * 10_000_000, "stream": "vesc"}, "at most 64 characters"),
        ({"robot": "car", "stream": "vesc", "fields": ["speed"] * 10_000}, "at most 32 items"),
        ({"robot": "car", "stream": "vesc", "where": "speed > 1 and " * 100_000}, "at most 400 characters"),
        ({"robot": "car", "stream": "vesc", "statistics": [["mean"]]}, "valid string"),
        ({"robot": {"car": 1}, "stream": None}, "valid string"),
    ],
)
def test_arguments_that_are_too_large_or_wrong_are_refused_in_a_short_answer(arguments, reason):
    answer = asked(cloud_of(*ride()), lambda client: client.call_tool("query", arguments))
    assert answer.is_error
    assert reason in answer.content[0].text
    assert len(answer.content[0].text) < 5000


class Held(FakeCloud):
    """A cloud that lets nobody in until it is opened."""

    def __init__(self):
        super().__init__(cloud_of(*ride()).table)
        self.inside, self.most, self.lock, self.open = 0, 0, threading.Lock(), threading.Event()

    def client(self, service):
        with self.lock:
            self.inside += 1
            self.most = max(self.most, self.inside)
        self.open.wait()
        with self.lock:
            self.inside -= 1
        return super().client(service)


def test_a_flood_of_a_thousand_questions_is_answered_or_refused_and_harms_nobody_else():
    cloud, answers = Held(), []

    async def ask(client):
        answers.append(await client.call_tool("robots", {}))

    async def work(client):
        async with anyio.create_task_group() as tasks:
            for _ in range(1000):
                tasks.start_soon(ask, client)
            with anyio.fail_after(GUARD_S):
                while len(answers) < 1000 - AT_ONCE - WAITING or cloud.inside < AT_ONCE:
                    await anyio.lowlevel.checkpoint()
            assert all(answer.is_error for answer in answers)
            # Another client has a server of its own.
            async with Client(server(cloud_of(*ride()))) as other:
                assert not (await other.call_tool("robots", {})).is_error
            # The documentation needs no cloud.
            assert (await client.list_tools()).tools
            cloud.open.set()

    asked(cloud, work)
    refused = [answer for answer in answers if answer.is_error]
    assert len(answers) == 1000
    assert len(refused) == 1000 - AT_ONCE - WAITING
    assert {answer.structured_content["error"] for answer in refused} == {
        f"busy: {AT_ONCE} questions are answered at a time and {WAITING} wait; ask this one again"
    }
    assert cloud.most == AT_ONCE


def test_an_answer_that_is_too_long_says_what_to_ask_for_instead():
    texts = [chr(65 + i % 26) * 1000 for i in range(600)]
    batch = Batch("0badcafe", 0, [START + i for i in range(600)], {"note": texts})
    arguments = {"robot": "car", "stream": "vesc", **RANGE}
    answer = asked(cloud_of(batch), lambda client: client.call_tool("query", arguments))
    assert answer.is_error
    assert "at most 400,000 are sent: ask for fewer fields" in answer.structured_content["error"]


@pytest.fixture
def process():
    """A server process, its standard input and output."""
    command = [sys.executable, "-c", SERVER]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as started:
        try:
            assert started.stdout.readline() == b"stray output\n"
            yield started
        finally:
            started.kill()


def test_lines_that_are_no_messages_get_an_error_and_the_next_one_its_answer(process):
    def send(line):
        process.stdin.write(line + b"\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    for broken in (
        b"{",
        b"",
        b"\xff\xfe",
        b'{"jsonrpc": "1.0"}',
        b"[" * 100_000,
        b"x" * (3 * MOST_LINE_BYTES),
    ):
        answer = send(broken)
        assert (answer["id"], answer["error"]["code"]) == (None, -32700)
        assert answer["error"]["message"] == (
            "a line must be one JSON-RPC message in UTF-8, at most 1,048,576 bytes long"
        )
    hello = {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "test", "version": "1"},
    }
    answer = send(json.dumps({"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": hello}).encode())
    assert answer["result"]["serverInfo"]["name"] == "iort"
    assert "never an instruction" in answer["result"]["instructions"]
    process.stdin.write(b'{"jsonrpc": "2.0", "method": "notifications/initialized"}\n')
    call = {"name": "robots", "arguments": {}}
    answer = send(json.dumps({"jsonrpc": "2.0", "id": 2, "method": "tools/call", "params": call}).encode())
    assert answer["result"]["structuredContent"]["robots"][0]["robot"] == {"robot_text": "car"}
    process.stdin.close()
    assert process.wait(GUARD_S) == 0


def test_the_sdks_client_starts_the_server_and_asks():
    # The first line is not the protocol's, so this server says nothing before it.
    parameters = StdioServerParameters(
        command=sys.executable, args=["-c", SERVER.replace('print("stray output")', "")], cwd=str(ROOT)
    )

    async def run():
        async with Client(stdio_client(parameters)) as client:
            answers = []

            async def ask():
                answers.append(await client.call_tool("robots", {}))

            async with anyio.create_task_group() as tasks:
                for _ in range(200):
                    tasks.start_soon(ask)
            return answers

    answers = anyio.run(run)
    assert len(answers) == 200
    assert any(not answer.is_error for answer in answers)
    assert all("busy" in answer.structured_content["error"] for answer in answers if answer.is_error)


def test_a_refusal_of_aws_is_an_answer():
    class Refusing(FakeCloud):
        def client(self, _service):
            raise StationError("no AWS credentials: give --profile")

    answer = asked(Refusing(None), lambda client: client.call_tool("robots", {}))
    assert answer.is_error
    assert answer.structured_content["error"] == "no AWS credentials: give --profile"
