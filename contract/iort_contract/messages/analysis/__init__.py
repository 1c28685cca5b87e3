"""The analysis' messages: a run, the findings it makes, and both for the page."""
