"""The analysis' messages: a run, its findings, people's notes beside them, and all of it for the page."""
