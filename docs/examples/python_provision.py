"""From a claim to a certificate, written from the message reference alone; the openssl command makes the key.

python docs/examples/python_provision.py claim car7    # the folder that `iort robots claim car7` wrote
"""

import json
import secrets
import subprocess
import sys
import time
from pathlib import Path
from queue import Queue
from typing import Any

import paho.mqtt.client as mqtt
from python_client import connecting, settings


class Claim:
    """A connection with a claim, good for two requests."""

    def __init__(self, folder: Path) -> None:
        self.settings = settings(folder / "claim.yaml")
        self.subscribed: Queue[bool] = Queue()
        self.answers: Queue[mqtt.MQTTMessage] = Queue()
        name = f"{self.settings['namespace']}-claim-{secrets.token_hex(4)}"
        self.mqtt = connecting(self.settings, folder, name)
        self.mqtt.on_connect = lambda *_: self.subscribed.put(True)
        self.mqtt.on_subscribe = lambda *_: self.subscribed.put(True)
        self.mqtt.on_message = lambda _client, _data, message: self.answers.put(message)
        self.mqtt.loop_start()
        self.subscribed.get(timeout=30)

    def ask(self, topic: str, request: dict[str, Any]) -> dict[str, Any]:
        """Subscribe to both answers, then ask."""
        self.mqtt.subscribe([(f"{topic}/accepted", 1), (f"{topic}/rejected", 1)])
        self.subscribed.get(timeout=30)
        self.mqtt.publish(topic, json.dumps(request), qos=1)
        answer = self.answers.get(timeout=30)
        said: dict[str, Any] = json.loads(answer.payload)
        if answer.topic.endswith("/rejected"):
            raise PermissionError(f"{said['errorCode']}: {said['errorMessage']}")
        return said


def openssl(*arguments: str) -> str:
    """What the command prints."""
    return subprocess.run(["openssl", *arguments], check=True, capture_output=True, text=True).stdout


def main(folder: Path, robot: str) -> None:
    """Make a key, have it certified and registered, and write the robot's own car.yaml."""
    claim, key = Claim(folder), folder / "private.key"
    openssl("genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256", "-out", str(key))
    request = openssl("req", "-new", "-sha256", "-key", str(key), "-subj", f"/CN={robot}")
    asked = {"certificateSigningRequest": request}
    made = claim.ask("$aws/certificates/create-from-csr/json", asked)
    serial = claim.settings.get("serial", "my-serial-number")
    register = {
        "certificateOwnershipToken": made["certificateOwnershipToken"],
        "parameters": {"Robot": robot, "Serial": serial},
    }
    template = f"$aws/provisioning-templates/{claim.settings['namespace']}-robot/provision/json"
    for wait_s in (1, 4, 0):
        try:
            claim.ask(template, register)
            break
        except PermissionError:
            if not wait_s:
                raise
            time.sleep(wait_s)
    (folder / "certificate.pem").write_text(made["certificatePem"])
    car = {**claim.settings, "robot": robot, "certificate": "certificate.pem", "private_key": "private.key"}
    (folder / "car.yaml").write_text("".join(f"{name}: {value}\n" for name, value in car.items()))
    claim.mqtt.disconnect()
    claim.mqtt.loop_stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
