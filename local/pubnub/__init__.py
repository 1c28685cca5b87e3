"""A server that stands in for PubNub on this machine. It uses the contract and aiohttp only."""
