"""The commands of `iort`, in a folder for each room of the station that they use.

A command reads its options, calls its room and prints the result. To add one, write a file with a
`typer.Typer` named ``commands``, and add its name here. The order is that of `iort --help`.
"""

COMMANDS = (
    "fleet.robots",
    "fleet.files",
    "page.pubnub",
    "page.dashboard",
    "operations.cost",
    "operations.audit",
    "data.streams",
    "data.runs",
    "data.query",
    "data.export",
    "data.plot",
    "operations.trace",
    "page.watch",
    "page.site",
    "operations.errors",
    "operations.adopt",
    "fleet.send",
    "fleet.config",
)
