"""The sockets of an embedded cloud: certificates, addresses, the door to the files, a relay for browsers."""
