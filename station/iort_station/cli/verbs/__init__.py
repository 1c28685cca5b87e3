"""The verbs of `iort`, in a folder for each room of the station that they use.

A verb reads its options, calls its room and prints the result. To add one, write a file with a `typer.Typer`
named ``commands``, and add a line here: the file, and what `iort --help` says of the verb. The verb has the
file's name. `iort` imports the file only when somebody uses the verb. The order is that of `iort --help`.
"""

VERBS = {
    "fleet.robots": "The robots that may connect.",
    "fleet.files": "Bags, images and other files that robots have uploaded.",
    "page.pubnub": "Store PubNub's keys, encrypted, where Lambda 1 reads them.",
    "page.dashboard": "Serve the live page until Ctrl-C.",
    "page.invite": "Print a link for one more browser that may stop and drive.",
    "operations.cost": "Print the cost of a fleet, at list prices.",
    "operations.archive": "Telemetry that is kept for good: show, run, verify.",
    "operations.audit": "Prove that every sample of a robot arrived.",
    "data.streams": "List a robot's streams: fields, runs, times.",
    "data.runs": "List the runs of a robot's agent.",
    "data.query": "Print recorded samples.",
    "data.export": "Write a recording: MCAP or a ROS 1 bag.",
    "data.plot": "Draw recorded samples.",
    "data.laps": "List laps: time, distance, energy, and compare two.",
    "operations.analyse": "Analyse robots' drives in the cloud, now.",
    "data.findings": "List what the analysis found about drives.",
    "data.note": "Write, list or delete notes about a robot.",
    "data.calibrate": "Print a car's parameters, for vesc.yaml too.",
    "operations.trace": "Measure the delay of live updates, hop by hop.",
    "page.watch": "Show every car in the terminal, live, until Ctrl-C.",
    "page.site": "Upload the page to the stack iort-site, which serves it.",
    "operations.alarms": "List the alarms with what to do, or acknowledge them.",
    "operations.errors": "List rejected messages, or show one.",
    "operations.replay_errors": "Process rejected recordings again.",
    "upkeep.doctor": "Say what is wrong with the cloud, or will be, and what to do.",
    "upkeep.backup": "Write the cloud of `make up` into one file, while it runs.",
    "upkeep.restore": "Make the cloud of `make up` from a backup.",
    "operations.move": "Copy robots and their recordings into another cloud.",
    "fleet.send": "Send a command and print the robot's answer.",
    "fleet.drive": "Drive a car by the keys of this terminal.",
    "fleet.stop": "Stop robots in an emergency, until --release.",
    "fleet.ask": "Ask the cloud what a robot may ask.",
    "fleet.config": "Show or change a robot's settings.",
}
