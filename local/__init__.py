"""The embedded cloud: AWS and PubNub on this machine, for the same app as is deployed to AWS."""
