"""Takes a deployment down: runs `cdk destroy --all`, and retries while AWS keeps the robots' policy.

    python scripts/destroy.py node node_modules/aws-cdk/bin/cdk destroy --all

"It can take up to five minutes after a policy is detached before it's ready to be deleted" (DeletePolicy, AWS
IoT API Reference). So the stack may fail right after `iort robots remove --all`. Any other failure ends the
script at once.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

# Five minutes, and one for clock differences.
TRIES, AGAIN_S = 13, 30.0
_POLICY_STAYS = re.compile(r"DELETE_FAILED.*AWS::IoT::Policy")


def main() -> None:
    """Run the command line's command until it succeeds."""
    sys.exit(destroy(sys.argv[1:], time.sleep))


def destroy(command: Sequence[str], wait: Callable[[float], None]) -> int:
    """Return the command's last exit status; ``wait`` waits the given seconds before each retry."""
    status, stays = run(command)
    for left in range(TRIES - 1, 0, -1):
        if not status or not stays:
            break
        print(
            "destroy: AWS keeps the robots' policy for up to five minutes after the last robot is removed: "
            f"again in {AGAIN_S:.0f} s, {left} {'times' if left > 1 else 'time'} at most",
            file=sys.stderr,
            flush=True,
        )
        wait(AGAIN_S)
        # The first run has asked for confirmation.
        status, stays = run([*command, "--force"])
    return status


def run(command: Sequence[str]) -> tuple[int, bool]:
    """Return the exit status, and whether a policy could not be deleted.

    The CDK asks on standard output, which stays the terminal. It reports on standard error, which is read and
    passed on.
    """
    # With CI set, it would report on standard output.
    environment = {name: value for name, value in os.environ.items() if name != "CI"}
    stays = False
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE) as process:
        for line in process.stderr or ():
            sys.stderr.buffer.write(line)
            sys.stderr.flush()
            stays = stays or bool(_POLICY_STAYS.search(line.decode(errors="replace")))
    return process.returncode, stays


if __name__ == "__main__":
    main()
