"""`make up-service`: `make up` as a service of systemd, which starts it at a boot and after a failure."""

from __future__ import annotations

import getpass
import os
import subprocess
import sys
from pathlib import Path
from string import Template

from iort_station.errors import StationError
from iort_station.page.password import Password, first_password
from local.deployment import ROOT
from local.processes import LocalError
from local.state import NO, StateFolder
from local.up import commands

NAME = "iort-cloud.service"
_UNIT = Template("""\
# Written by `make up-service`.
[Unit]
Description=iort: the laboratory's own cloud
After=network-online.target
Wants=network-online.target

[Service]
Type=notify
WorkingDirectory=$root
ExecStart=$command
# Its name in the journal.
SyslogIdentifier=iort-cloud
Restart=on-failure
RestartSec=5
# The first start deploys everything.
TimeoutStartSec=900
TimeoutStopSec=60
KillMode=mixed
# Only what the cloud needs.
NoNewPrivileges=yes
UMask=0077

[Install]
WantedBy=$wanted
""")


def main() -> None:
    """Write the unit, and start it: a service of the machine for root, and of the user for others."""
    parser = commands.parser(
        "up-service", "Run `make up` as a service of systemd.", remembered=True, more="[REMOVE=1]"
    )
    parser.add_argument(
        "--remove", action="store_true", help="stop the service and remove it; the cloud is kept"
    )
    parser.add_argument("--print", action="store_true", help="print the unit, and change nothing")
    given = parser.parse_args()
    of_machine = os.geteuid() == 0
    text = unit(commands.flags(given), of_machine=of_machine)
    try:
        if given.print:
            _say(text)
        elif given.remove:
            _remove(of_machine=of_machine)
        else:
            _check()
            _make_password(given.state, given.page)
            _install(text, of_machine=of_machine)
    except (LocalError, StationError) as error:
        sys.exit(f"up-service: {error}")


def unit(flags: list[str], *, of_machine: bool) -> str:
    """The text of the unit."""
    command = [sys.executable, "-m", "local.up.run", *flags]
    return _UNIT.substitute(
        root=_quoted(str(ROOT), inner=True),
        command=" ".join(_quoted(one) for one in command),
        wanted="multi-user.target" if of_machine else "default.target",
    )


def _check() -> None:
    """Raise `LocalError` where it could not run."""
    if not Path("/run/systemd/system").is_dir():
        raise LocalError(
            "systemd must run this machine, got none: run `make up` in a terminal that stays, such as tmux"
        )
    if os.environ.get("SUDO_USER"):
        # Checkout and state are the user's, and root's files in them would be in the way.
        raise LocalError("must run without sudo: a service of the user starts with the machine, too")


def _make_password(folder: Path, page: str | None) -> None:
    """Make the page's first password here: the service would write it into the journal."""
    state = StateFolder(folder, kept=True)
    state.prepare()
    if (page or state.settings().page) != NO and (made := Password(folder).make()):
        _say(f"the page's {first_password(made, 'make up-password', sys.stdout)}")


def _install(text: str, *, of_machine: bool) -> None:
    path = _folder(of_machine=of_machine) / NAME
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    _systemctl("daemon-reload", of_machine=of_machine)
    _systemctl("enable", NAME, of_machine=of_machine)
    _say(f"{path} is written; starting it (the first time takes a minute or two)")
    _systemctl("restart", NAME, of_machine=of_machine)
    user, lingers = "" if of_machine else " --user", of_machine or _lingers()
    _say(
        f"up{', and started with the machine from now on' if lingers else ''}\n"
        f"  its state   systemctl{user} status {NAME}\n"
        f"  its log     journalctl{user} --unit {NAME} --follow\n"
        f"  to stop     systemctl{user} stop {NAME}\n"
        f"  to remove   make up-service REMOVE=1"
    )
    if not lingers:
        _say(
            f"After a reboot it starts when {getpass.getuser()} logs in, and it ends at the logout: "
            f"`sudo loginctl enable-linger {getpass.getuser()}` changes both"
        )


def _remove(*, of_machine: bool) -> None:
    _systemctl("disable", "--now", NAME, of_machine=of_machine)
    (_folder(of_machine=of_machine) / NAME).unlink(missing_ok=True)
    _systemctl("daemon-reload", of_machine=of_machine)
    _say("removed; the cloud is kept")


def _folder(*, of_machine: bool) -> Path:
    if of_machine:
        return Path("/etc/systemd/system")
    home = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(home) / "systemd" / "user"


def _lingers() -> bool:
    """Let the user linger: without that its services run only while it is logged in. Whether it does."""
    command = ["loginctl", "enable-linger", getpass.getuser()]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0  # noqa: S603 - systemd's own


def _systemctl(*arguments: str, of_machine: bool) -> None:
    command = ["systemctl", *([] if of_machine else ["--user"]), *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603 - as above
    if done.returncode:
        raise LocalError(f"`{' '.join(command)}` failed: {done.stderr.strip()}")


def _quoted(text: str, *, inner: bool = False) -> str:
    """A text as systemd reads it: % and $ begin something else there."""
    escaped = text.replace("%", "%%")
    if inner:
        return escaped
    escaped = escaped.replace("$", "$$").replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - a command's words to its user


if __name__ == "__main__":
    main()
