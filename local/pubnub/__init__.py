"""A server that stands in for PubNub on this machine. It uses the contract and the station's web server."""
