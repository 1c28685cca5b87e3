"""Takes a deployment down: runs `cdk destroy --all`, and again while AWS keeps the robots' policy.

    python scripts/destroy.py node node_modules/aws-cdk/bin/cdk destroy --all

"It can take up to five minutes after a policy is detached before it's ready to be deleted" (DeletePolicy, AWS
IoT API Reference), so straight after `iort robots remove --all` the stack may fail on it. Any other failure
ends it at once.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

# Five minutes, and one for the clock of whoever counts them.
TRIES, AGAIN_S = 13, 30.0
_POLICY_STAYS = re.compile(r"DELETE_FAILED.*AWS::IoT::Policy")


def main() -> None:
    """Run the command line's command until it is through."""
    sys.exit(destroy(sys.argv[1:], time.sleep))


def destroy(command: Sequence[str], wait: Callable[[float], None]) -> int:
    """The command's last exit status; ``wait`` is told for how many seconds before each further try."""
    status, stays = run(command)
    for left in range(TRIES - 1, 0, -1):
        if not status or not stays:
            break
        print(
            "destroy: AWS deletes the robots' policy up to five minutes after its last robot went: "
            f"again in {AGAIN_S:.0f} s, {left} {'times' if left > 1 else 'time'} at most",
            file=sys.stderr,
            flush=True,
        )
        wait(AGAIN_S)
        # It has asked whether to.
        status, stays = run([*command, "--force"])
    return status


def run(command: Sequence[str]) -> tuple[int, bool]:
    """The exit status, and whether a policy could not be deleted.

    The CDK asks on standard output, which stays the terminal; what it does it says on standard error, which
    is read and passed on.
    """
    # With CI it would say it on standard output.
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
