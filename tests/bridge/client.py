"""A client of Foxglove's protocol that is not ours, as a program: it takes a line of JSON for each thing to
do, and prints one for each thing that happens.

It runs in a process of its own, because `robo_ws_bridge` has the GPL. What that client has no method for, the
request to play and its answer, goes over its own connection.
"""

from __future__ import annotations

import asyncio
import base64
import json
import struct
import sys
from typing import Any

from robo_ws_bridge import WebSocketBridgeClient


def tell(event: str, **facts: Any) -> None:
    sys.stdout.write(json.dumps({"event": event, **facts}) + "\n")
    sys.stdout.flush()


def playback(command: dict[str, Any]) -> bytes:
    """A request to control playback, as the protocol has it."""
    seek, request = command.get("seek_ns"), str(command.get("id", "")).encode()
    head = struct.pack("<BBf", 3, 0 if command["play"] else 1, command.get("speed", 1.0))
    at = struct.pack("<BQ", seek is not None, seek or 0)
    return head + at + struct.pack("<I", len(request)) + request


class Client(WebSocketBridgeClient):
    """Tells playback's state, too."""

    async def _handle_binary(self, data: bytes) -> None:
        if data[0] == 5:
            status, at_ns, speed, seeked = struct.unpack_from("<BQf?", data, 1)
            tell("state", status=status, at_ns=at_ns, speed=speed, seeked=seeked, id=data[19:].decode())
        await super()._handle_binary(data)


async def main(url: str) -> None:
    client = Client(url)
    client.on_server_info(lambda *info: tell("server", info=client.server_info))
    client.on_advertised_channel(lambda channel: tell("channel", channel=channel))
    client.on_status(lambda level, text, name: tell("status", level=level, text=text, name=name))
    client.on_message(
        lambda channel, t_ns, data: tell(
            "message", topic=channel["topic"], t_ns=t_ns, data=base64.b64encode(data).decode()
        )
    )
    client.on_connect(lambda: tell("connected"))
    client.on_disconnect(lambda: tell("disconnected"))
    await client.connect()
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    published: dict[str, int] = {}
    while line := await lines.readline():
        command = json.loads(line)
        match command["do"]:
            case "subscribe":
                await client.subscribe(command["topic"])
            case "unsubscribe":
                await client.unsubscribe(command["topic"])
            case "playback":
                await client._websocket.send(playback(command))
            case "advertise":
                published[command["topic"]] = await client.advertise(
                    command["topic"], encoding="json", schema_name=command["schema"]
                )
            case "publish":
                await client.publish(published[command["topic"]], json.dumps(command["message"]).encode())
    await client.disconnect()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
