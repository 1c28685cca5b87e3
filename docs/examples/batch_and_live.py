"""Store a batch and show a live sample: python batch_and_live.py HOST PORT ROBOT FOLDER AUTHORITIES."""

import base64
import json
import secrets
import ssl
import sys
import time
import zlib

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

host, port, robot, folder, authorities = sys.argv[1:]
tls = ssl.create_default_context(cafile=authorities)
tls.load_cert_chain(f"{folder}/certificate.pem", f"{folder}/private.key")
client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=robot, protocol=mqtt.MQTTv5)
client.tls_set_context(tls)
client.connect(host, int(port))
client.loop_start()

run, now_us = secrets.token_hex(8), time.time_ns() // 1000
columns = json.dumps({"dt": [0, 20_000], "fields": {"angle": [None, 0.5, 1.5]}})
samples = base64.b64encode(zlib.compress(columns.encode())).decode()
batch = {"v": 2, "batch": f"{now_us:016d}-{run}-0", "n": 2, "codec": "steps", "samples": samples}
client.publish(f"$aws/rules/iort_record/dt/iort/{robot}/arm", json.dumps(batch), qos=1).wait_for_publish(9)
live = {
    "v": 1,
    "boot": run,
    "seq": 0,
    "t": now_us,
    "sent_us": now_us,
    "nonfinite": 0,
    "sample": {"angle": 1.5},
}
client.publish(f"live/iort/{robot}/arm", json.dumps(live)).wait_for_publish(9)
client.disconnect()
