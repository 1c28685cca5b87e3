"""The emulator's listeners, and the end of connections that never authenticate."""

from __future__ import annotations

import asyncio
import ipaddress
import ssl
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


WAIT_S = 0.5
# MQTT 3.1.1, clean session, a keep-alive of 60 s, client id "a"; and its answer, accepted.
CONNECT = b"\x10\x0d\x00\x04MQTT\x04\x02\x00\x3c\x00\x01a"
CONNACK = b"\x20\x02\x00\x00"


@pytest.fixture
def ended(monkeypatch):
    """Return whether the emulator's own acceptor ends a connection within four times its wait."""
    monkeypatch.setattr(iot, "_MTLS_CONNECT_SECONDS", WAIT_S)

    async def run(tls, said):
        # Made beforehand, since this takes longer than the wait.
        await iot._mtls_context()
        loop = asyncio.get_running_loop()
        server = await loop.create_server(iot._MtlsAcceptor, host="127.0.0.1", port=0)
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        address = server.sockets[0].getsockname()
        reader, writer = await asyncio.open_connection(*address, ssl=context if tls else None)
        writer.write(said)
        try:
            if said:
                assert await reader.readexactly(len(CONNACK)) == CONNACK
            return await asyncio.wait_for(reader.read(), 4 * WAIT_S) == b""
        except ConnectionResetError:
            return True
        except asyncio.TimeoutError:
            return False
        finally:
            writer.close()
            server.close()

    return lambda *, tls, said=b"": asyncio.run(run(tls, said))


def test_a_connection_that_never_authenticates_is_closed(ended):
    assert ended(tls=False)
    assert ended(tls=True)


def test_a_session_outlives_the_connect_timeout(ended):
    assert not ended(tls=True, said=CONNECT)
