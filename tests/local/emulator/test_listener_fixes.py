"""The emulator's listeners, and the end of connections that never authenticate."""

from __future__ import annotations

import asyncio
import ipaddress
import ssl
from contextlib import suppress
from pathlib import Path

import pytest
from ministack.services import iot


def listening(pid: int) -> set[tuple[str, int]]:
    """Return the addresses and ports on which a process listens, as Linux reports them."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        target = str(descriptor.readlink())
        if target.startswith("socket:["):
            inodes.add(target[len("socket:[") : -1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *rest = line.split()
            if state == "0A" and rest[5] in inodes:
                address, port = local.split(":")
                words = [bytes.fromhex(address[i : i + 8])[::-1] for i in range(0, len(address), 8)]
                found.add((str(ipaddress.ip_address(b"".join(words))), int(port, 16)))
    return found


def test_every_listener_of_the_emulator_is_on_loopback(embedded):
    found = listening(embedded.emulator.pid)
    assert embedded.cloud.mqtt_port in {port for _, port in found}
    assert {address for address, _ in found} == {"127.0.0.1"}


def test_the_broker_takes_over_a_renewed_certificate(embedded):
    def shown():
        return ssl.get_server_certificate((embedded.host, embedded.cloud.mqtt_port)).strip()

    (broker,) = embedded.certificates
    before = shown()
    assert before in broker.path.read_text()
    broker.path.unlink()
    assert embedded.renew()
    assert before not in broker.path.read_text()
    assert shown() in broker.path.read_text()


# MQTT 3.1.1, clean session, a keep-alive of 60 s, client id "a"; and its answer, accepted.
CONNECT = b"\x10\x0d\x00\x04MQTT\x04\x02\x00\x3c\x00\x01a"
CONNACK = b"\x20\x02\x00\x00"
PING, PONG = b"\xc0\x00", b"\xd0\x00"


def talk(steps, *, tls):
    """Let a client's steps talk to the emulator's own acceptor. They get the connection, and a function that
    lets the time for a CONNECT pass at once."""

    async def run():
        await iot._mtls_context()
        loop = asyncio.get_running_loop()
        passed_s, now = 0.0, loop.time

        def late():
            nonlocal passed_s
            passed_s += iot._MTLS_CONNECT_SECONDS + 1

        loop.time = lambda: now() + passed_s
        server = await loop.create_server(iot._MtlsAcceptor, host="127.0.0.1", port=0)
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        address = server.sockets[0].getsockname()
        reader, writer = await asyncio.open_connection(*address, ssl=context if tls else None)
        try:
            await steps(reader, writer, late)
        finally:
            writer.close()
            server.close()

    asyncio.run(run())


@pytest.mark.parametrize("tls", [False, True])
def test_a_connection_that_never_authenticates_is_closed(tls):
    async def says_nothing(reader, _writer, late):
        end = asyncio.ensure_future(reader.read())
        for _ in range(1000):
            # The acceptor may begin to wait only now.
            late()
            await asyncio.sleep(0.01)
            if end.done():
                break
        with suppress(ConnectionResetError):
            assert end.result() == b""

    talk(says_nothing, tls=tls)


def test_a_session_outlives_the_connect_timeout():
    async def connects(reader, writer, late):
        writer.write(CONNECT)
        assert await reader.readexactly(len(CONNACK)) == CONNACK
        late()
        writer.write(PING)
        assert await reader.readexactly(len(PONG)) == PONG

    talk(connects, tls=True)
