"""The emergency stop and who drives, from the operator to a simulated car and back, on the embedded cloud."""

from __future__ import annotations

from iort_contract.messages.shadow import decode_reported
from iort_station import data
from iort_station.operations import delivery
from local.demo import DOWNLINK
from tests.local.conftest import until
from tests.local.robots.test_shadow import Shadow, driving

FORWARDS = '{"drive": {"speed": 9.0}}'


def test_a_car_is_driven_stopped_and_released_and_the_stop_outlives_the_agent(embedded, bundle, iort):
    car = bundle(sources=[{"type": "sim", "rate_hz": 50}], downlink=DOWNLINK)
    robot, shadow = car.robot, Shadow(embedded, car.robot)

    def send():
        return iort("send", robot, "drive", FORWARDS, "--lease-ms", "1000")

    with driving(car):
        until(lambda: decode_reported(shadow.reported()).drive)
        assert decode_reported(shadow.reported()).drive.max_speed_mps == 2.0
        assert until(lambda: "has accepted drive" in send().output)
        stopped = iort("stop", robot)
        assert stopped.output == f"{robot}: stopped\n"
        refused = send()
        assert refused.exit_code == 1
        assert "emergency stop" in str(refused.exception)
    assert iort("stop", robot).output == f"{robot}: stopped\n", "as it said before it ended"
    with driving(car):
        until(lambda: "emergency stop" in str(send().exception))
        assert iort("stop", robot, "--release").output == f"{robot}: released\n"
        assert "has accepted drive" in send().output
    until(lambda: list(delivery.batches(embedded.cloud, robot, "drive")))
    told = data.query(embedded.cloud, robot, "drive", "-1h", "now")
    outcomes = list(told.columns["outcome"])
    assert {"accepted", "stopped", "emergency_stop"} <= set(outcomes)
    assert max(speed for speed in told.columns["speed"] if speed is not None) == 2.0, "car.yaml's limit"
