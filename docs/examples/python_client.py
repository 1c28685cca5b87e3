"""A robot written from the message reference alone, with Python's standard library and paho-mqtt 2.

python docs/examples/python_client.py car7    # the folder that `iort robots add car7` wrote
"""

import base64
import hashlib
import itertools
import json
import secrets
import ssl
import sys
import time
import urllib.request
import zlib
from collections import defaultdict
from pathlib import Path
from queue import Queue
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion


def now_us() -> int:
    """Microseconds since the epoch, by this machine's clock."""
    return time.time_ns() // 1000


def settings(file: Path) -> dict[str, str]:
    """The lines `key: value` of car.yaml or claim.yaml; a parser of YAML does it as well."""
    lines = (line for line in file.read_text().splitlines() if ": " in line and line[0] not in " -")
    return dict(line.replace("'", "").split(": ", 1) for line in lines)


def trusting(car: dict[str, str], folder: Path) -> ssl.SSLContext:
    """The authorities of the system and, for the embedded cloud, its own."""
    context = ssl.create_default_context()
    if "root_ca" in car:
        context.load_verify_locations(folder / car["root_ca"])
    return context


def connecting(car: dict[str, str], folder: Path, client_id: str) -> mqtt.Client:
    """A client that is about to connect; it begins with `loop_start`."""
    tls = trusting(car, folder)
    tls.load_cert_chain(folder / car["certificate"], folder / car["private_key"])
    if car["port"] == "443":
        tls.set_alpn_protocols(["x-amzn-mqtt-ca"])
    client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=client_id, protocol=mqtt.MQTTv5)
    client.tls_set_context(tls)
    client.connect_async(car["endpoint"], int(car["port"]), keepalive=30)
    return client


class Robot:
    """The connection of one robot, and what it can say and hear."""

    def __init__(self, bundle: Path) -> None:
        car = settings(bundle / "car.yaml")
        self.name, self.mine = car["robot"], f"{car['namespace']}/{car['robot']}"
        self.rules = f"$aws/rules/{car['namespace']}"
        # Names this run. Batches, live messages and pings are numbered from 0 in each.
        self.run = secrets.token_hex(8)
        self.numbers: defaultdict[str, Any] = defaultdict(itertools.count)
        self.offset_us, self.newest = 0, (0, "", -1)
        self.subscribed: Queue[bool] = Queue()
        self.answers: Queue[dict[str, Any]] = Queue()
        self.commands: Queue[dict[str, Any]] = Queue()
        self.trust = trusting(car, bundle)
        self.mqtt = connecting(car, bundle, self.name)
        self.mqtt.on_connect = self.connected
        self.mqtt.on_publish = self.acknowledged
        self.mqtt.on_subscribe = lambda *_: self.subscribed.put(True)
        self.mqtt.on_message = lambda _client, _data, message: self.receive(message)
        self.mqtt.loop_start()
        self.subscribed.get(timeout=30)

    def connected(self, *_: object) -> None:
        """Subscribe on each connection: a clean session has forgotten what the one before had."""
        self.mqtt.subscribe([(f"{lane}/{self.mine}/+", 1) for lane in ("cmd", "pong")])

    def acknowledged(self, _client: object, _data: object, _id: int, reason: Any, _more: object) -> None:
        """Say so where the broker has refused a message: it is nowhere then."""
        if reason.is_failure:
            print(f"refused: {reason}", file=sys.stderr)

    def publish(self, topic: str, message: dict[str, Any], qos: int = 1) -> mqtt.MQTTMessageInfo:
        """Hand a message to the network's thread."""
        return self.mqtt.publish(topic, json.dumps(message), qos)

    def record(self, stream: str, times_us: list[int], columns: dict[str, list[Any]]) -> str:
        """Have a batch stored; its id, once the broker has it."""
        dt = [0, *(later - earlier for earlier, later in itertools.pairwise(times_us))]
        body = json.dumps({"dt": dt, "fields": {name: [None, *values] for name, values in columns.items()}})
        batch = f"{times_us[0]:016d}-{self.run}-{next(self.numbers[stream])}"
        samples = base64.b64encode(zlib.compress(body.encode())).decode()
        envelope = {"v": 2, "batch": batch, "n": len(dt), "codec": "steps", "samples": samples}
        sent = self.publish(f"{self.rules}_record/dt/{self.mine}/{stream}", envelope)
        sent.wait_for_publish(30)
        if not sent.is_published():
            raise TimeoutError(f"no PUBACK for {batch}: publish it again")
        return batch

    def live(self, stream: str, t_us: int, sample: dict[str, Any]) -> None:
        """Show a sample now, or never."""
        head = {"v": 1, "boot": self.run, "seq": next(self.numbers[f"live {stream}"]), "nonfinite": 0}
        times = {"t": t_us, "sent_us": now_us(), "offset_us": self.offset_us}
        self.publish(
            f"{self.rules}_live/live/{self.mine}/{stream}", {**head, **times, "sample": sample}, qos=0
        )

    def ask(self, path: str, question: dict[str, Any]) -> dict[str, Any]:
        """Ask on the lane ping, and wait for the answer that has the question's id."""
        self.publish(f"ping/{self.mine}/{path}", question)
        while True:
            answer = self.answers.get(timeout=30)
            if answer["id"] == question["id"]:
                return answer

    def ping(self) -> float:
        """Learn what to add to this clock to have the cloud's; the round trip in milliseconds."""
        sent_us = now_us()
        pong = self.ask("rule", {"v": 1, "id": next(self.numbers["ping"]), "sent_us": sent_us})
        trip_us = now_us() - sent_us
        self.offset_us = pong["received_ms"] * 1000 + 500 - sent_us - trip_us // 2
        return trip_us / 1000

    def upload(self, file: Path) -> str:
        """Bring a file of up to 8 MiB into the bucket; its key there."""
        content = file.read_bytes()
        sha256 = hashlib.sha256(content).hexdigest()
        about = {"name": file.name, "kind": "other", "content_type": "application/octet-stream"}
        sizes = {"size": len(content), "sha256": sha256, "t": file.stat().st_mtime_ns // 1000}
        while True:
            question = {
                "v": 1,
                "id": secrets.token_hex(8),
                "file": {**about, **sizes},
                "parts": {"1": sha256},
            }
            answer = self.ask("file", question)
            if "refused" in answer:
                raise PermissionError(answer["refused"])
            if answer["stored"]:
                return str(answer["key"])
            (address,) = answer["addresses"]
            put = urllib.request.Request(address["url"], content, address["headers"], method="PUT")
            urllib.request.urlopen(put, context=self.trust).close()

    def receive(self, message: mqtt.MQTTMessage) -> None:
        """Called by the network's thread with each message that comes in."""
        lane, _, _, name = message.topic.split("/")
        said = json.loads(message.payload)
        if lane == "pong":
            self.answers.put(said)
            return
        # A command: only what is newer than all before it, and not stale.
        order = (said["started_us"], said["session"], said["seq"])
        age_us = now_us() + self.offset_us - said["sent_us"]
        outcome = "accepted" if order > self.newest and age_us <= said["valid_ms"] * 1000 else "stale"
        if outcome == "accepted":
            self.newest = order
            self.commands.put({name: said["message"]})
        if said.get("answer"):
            about = {"session": said["session"], "seq": said["seq"], "outcome": outcome}
            state = {"state": {"reported": {"commands": {name: about}}}}
            self.publish(f"$aws/things/{self.name}/shadow/name/agent/update", state)

    def close(self) -> None:
        """Say goodbye, so that the fleet's table has the robot offline at once."""
        self.mqtt.disconnect()
        self.mqtt.loop_stop()


def main(bundle: Path) -> None:
    """Store a batch and a file, then show a sample a second until a command comes."""
    robot, start_us = Robot(bundle), now_us()
    print(json.dumps({"round_trip_ms": robot.ping(), "offset_us": robot.offset_us}), flush=True)
    columns: dict[str, list[Any]] = {"angle": [0.5, 1.5, None], "grip": [True, False, "x"]}
    batch = robot.record("arm", [start_us, start_us + 20_000, start_us + 40_000], columns)
    print(json.dumps({"batch": batch, "key": robot.upload(bundle / "car.yaml")}), flush=True)
    while robot.commands.empty():
        robot.live("arm", now_us(), {"angle": 1.5, "grip": "x"})
        time.sleep(1)
    print(json.dumps({"command": robot.commands.get()}), flush=True)
    robot.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
