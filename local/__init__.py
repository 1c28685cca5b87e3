"""The embedded cloud: AWS and PubNub on this machine, with the app that is also deployed to AWS.

It may use everything but bench/ and scripts/. It is never installed.
"""
