"""One function as AWS runs it: its own runtime interface client, a Runtime API, the layer, the log format.

Everything is on this machine. What AWS' Python has beside the function (boto3) is this environment's.
"""
