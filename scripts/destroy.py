"""Takes a deployment down: runs `cdk destroy --all`, and retries what only needs time.

    python scripts/destroy.py node node_modules/aws-cdk/bin/cdk destroy --all

The schedules are switched off first, so that no function writes into the bucket while stacks go. Two causes
of a failed deletion pass: "It can take up to five minutes after a policy is detached before it's ready to be
deleted" (DeletePolicy, AWS IoT API Reference), and what a running function or a robot stored after the bucket
was found empty, which is deleted. Any other failure ends the script at once.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import files
from verify.preflight.__main__ import context, options
from verify.preflight.deployed import stack

# Five minutes, and one for clock differences.
TRIES, AGAIN_S = 13, 30.0
_POLICY_STAYS = re.compile(r"DELETE_FAILED.*AWS::IoT::Policy")
_BUCKET_STAYS = re.compile(r"DELETE_FAILED.*AWS::S3::Bucket")
# What the answer of a schedule has, and a change does not take.
_NOT_ITS_OWN = {"Arn", "CreationDate", "LastModificationDate", "ResponseMetadata"}


class Deployment:
    """The deployed stacks of a namespace."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud, self._paused = cloud, list[dict[str, Any]]()

    def pause(self) -> None:
        """Switch the schedules off; they are found by the names that CloudFormation makes."""
        client = self._cloud.client("scheduler")
        for page in client.get_paginator("list_schedules").paginate(NamePrefix=f"{self._cloud.namespace}-"):
            for one in page["Schedules"]:
                if one.get("State") != "DISABLED":
                    found = client.get_schedule(Name=one["Name"], GroupName=one["GroupName"])
                    schedule = {name: value for name, value in found.items() if name not in _NOT_ITS_OWN}
                    client.update_schedule(**{**schedule, "State": "DISABLED"})
                    self._paused.append(schedule)

    def resume(self) -> None:
        """Switch those on again that are still there."""
        client = self._cloud.client("scheduler")
        for schedule in self._paused:
            try:
                client.update_schedule(**schedule)
            except client.exceptions.ResourceNotFoundException:  # noqa: PERF203 - the others may stand
                continue
        self._paused.clear()

    def is_empty(self) -> bool:
        """Whether the files' bucket can be deleted, or is gone."""
        return stack(self._cloud, f"{self._cloud.namespace}-storage") is None or files.is_empty(self._cloud)

    def empty(self) -> None:
        """Delete what came into it since."""
        files.empty(self._cloud)


def main() -> None:
    """Run the command line's command until it succeeds."""
    given = options(sys.argv[1:])
    cloud = Cloud(
        namespace=context(given.context).get("namespace") or Cloud().namespace, profile=given.profile
    )
    try:
        sys.exit(destroy(sys.argv[1:], time.sleep, Deployment(cloud)))
    except (StationError, BotoCoreError, ClientError) as error:
        sys.exit(f"destroy: {error}")


def destroy(command: Sequence[str], wait: Callable[[float], None], deployment: Deployment) -> int:
    """Return the command's last exit status; ``wait`` waits the given seconds before each retry."""
    deployment.pause()
    try:
        if not deployment.is_empty():
            print("destroy: the files' bucket is not empty: `iort files empty`, then again", file=sys.stderr)
            return 1
        status, stays = run(command)
        for left in range(TRIES - 1, 0, -1):
            if not status or not stays:
                break
            if _BUCKET_STAYS in stays:
                print("destroy: objects came into the bucket meanwhile: emptied again", file=sys.stderr)
                deployment.empty()
            if _POLICY_STAYS in stays:
                print(
                    "destroy: AWS keeps the robots' policy for up to five minutes after the last robot is "
                    f"removed: again in {AGAIN_S:.0f} s, {left} {'times' if left > 1 else 'time'} at most",
                    file=sys.stderr,
                    flush=True,
                )
                wait(AGAIN_S)
            # The first run has asked for confirmation.
            status, stays = run([*command, "--force"])
        return status
    finally:
        # Somebody may have said no, or a stack may stand.
        deployment.resume()


def run(command: Sequence[str]) -> tuple[int, set[re.Pattern[str]]]:
    """Return the exit status, and which of the causes that pass it reported.

    The CDK asks on standard output, which stays the terminal. It reports on standard error, which is read and
    passed on.
    """
    # With CI set, it would report on standard output.
    environment = {name: value for name, value in os.environ.items() if name != "CI"}
    stays: set[re.Pattern[str]] = set()
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE) as process:
        for line in process.stderr or ():
            sys.stderr.buffer.write(line)
            sys.stderr.flush()
            text = line.decode(errors="replace")
            stays |= {cause for cause in (_POLICY_STAYS, _BUCKET_STAYS) if cause.search(text)}
    return process.returncode, stays


if __name__ == "__main__":
    main()
