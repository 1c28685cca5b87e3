"""The relays of a deployment: asked by a viewer's rights, kept while their credentials are good."""

from __future__ import annotations

import boto3
import pytest
from botocore.stub import Stubber

from iort_agent.video.offers import of_deployment
from iort_contract.messages.video import OFFER, IceServer, Look, decode_look, encode_look
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet.relays import Relays
from iort_station.page.answers import ice
from testkit.agent import ManualClock

CHANNEL = "arn:aws:kinesisvideo:eu-west-1:123456789012:channel/turn/1700000000000"
ROLE = "arn:aws:iam::123456789012:role/viewer"
ENDPOINT = "https://r-90d1e8b2.kinesisvideo.eu-west-1.amazonaws.com"
URLS = (
    "turn:1-2-3-4.t-4bd75331.kinesisvideo.eu-west-1.amazonaws.com:443?transport=udp",
    "turns:1-2-3-4.t-4bd75331.kinesisvideo.eu-west-1.amazonaws.com:443?transport=tcp",
)
STUN = IceServer(("stun:stun.kinesisvideo.eu-west-1.amazonaws.com:443",))


class Deployed(Cloud):
    """A deployment whose stack `fleet` has these outputs."""

    def find_output(self, noun, name):
        return {**self.outputs}.get(name) if noun == "fleet" else None


class Asked:
    """AWS: answers as it documents, and keeps what it was asked."""

    def __init__(self):
        self.servers = [{"Uris": list(URLS), "Username": "u", "Password": "p", "Ttl": 300}]
        self.endpoints = [{"Protocol": "HTTPS", "ResourceEndpoint": ENDPOINT}]
        self.error = ""
        self.made = []

    def client(self, service, credentials, region, url):
        self.made.append((service, credentials.token, region, url))
        client = boto3.Session(region_name=region).client(
            service, aws_access_key_id="x", aws_secret_access_key="y", endpoint_url=url
        )
        stub = Stubber(client)
        if service == "kinesisvideo":
            wanted = {"Protocols": ["HTTPS"], "Role": "VIEWER"}
            stub.add_response(
                "get_signaling_channel_endpoint",
                {"ResourceEndpointList": self.endpoints},
                {"ChannelARN": CHANNEL, "SingleMasterChannelEndpointConfiguration": wanted},
            )
        elif self.error:
            stub.add_client_error("get_ice_server_config", self.error)
        else:
            stub.add_response(
                "get_ice_server_config", {"IceServerList": self.servers}, {"ChannelARN": CHANNEL}
            )
        stub.activate()
        return client


@pytest.fixture
def asked():
    return Asked()


def relays_of(asked, clock=None, **outputs):
    cloud = Deployed(region="eu-west-1")
    vars(cloud)["outputs"] = outputs
    sts = boto3.Session(region_name="eu-west-1").client(
        "sts", aws_access_key_id="x", aws_secret_access_key="y"
    )
    stub = Stubber(sts)
    keys = {"AccessKeyId": "A" * 16, "SecretAccessKey": "s", "SessionToken": "viewer's"}
    stub.add_response(
        "assume_role",
        {"Credentials": {**keys, "Expiration": "2030-01-01T00:00:00Z"}},
        {"RoleArn": ROLE, "RoleSessionName": "iort-viewer", "DurationSeconds": 3600},
    )
    stub.activate()
    vars(cloud)["_clients"] = {("sts", None): sts}
    return Relays(cloud, clients=asked.client, clock=(clock or ManualClock()).monotonic)


DEPLOYED = {"TurnChannel": CHANNEL, "ViewerRole": ROLE}


def test_a_viewer_gets_the_channels_servers_by_the_viewers_rights(asked):
    servers = relays_of(asked, **DEPLOYED).servers()
    assert servers == [STUN, IceServer(URLS, "u", "p")]
    assert asked.made == [
        ("kinesisvideo", "viewer's", "eu-west-1", None),
        ("kinesis-video-signaling", "viewer's", "eu-west-1", ENDPOINT),
    ]
    # They fit into an offer as they are.
    look = Look("0badcafe", "0badcafe", OFFER, sdp="v=0", ice_servers=tuple(servers))
    assert decode_look(encode_look(look)) == look
    # A robot takes them from it.
    assert of_deployment(look.ice_servers) == tuple(servers)


def test_the_pages_server_answers_with_them_as_a_browser_takes_them(asked):
    assert ice(relays_of(asked, **DEPLOYED)) == {
        "ice_servers": [
            {"urls": list(STUN.urls), "username": "", "credential": ""},
            {"urls": list(URLS), "username": "u", "credential": "p"},
        ]
    }
    assert ice(relays_of(asked)) == {"ice_servers": []}


def test_they_are_asked_again_a_minute_before_their_credentials_end(asked):
    clock = ManualClock()
    relays = relays_of(asked, clock, **DEPLOYED)
    first = relays.servers()
    clock.advance(239)
    asked.servers[0]["Password"] = "another"
    assert relays.servers() == first
    clock.advance(1)
    assert relays.servers()[1].credential == "another"
    assert len(asked.made) == 4


def test_a_deployment_without_them_asks_nobody(asked):
    assert relays_of(asked, ViewerRole=ROLE).servers() == []
    assert asked.made == []


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"error": "ClientLimitExceededException"}, "ClientLimitExceededException"),
        ({"endpoints": []}, "'HTTPS'"),
        ({"servers": [{"Uris": list(URLS), "Username": "u", "Ttl": 300}]}, "'Password'"),
    ],
)
def test_what_aws_refuses_or_answers_otherwise_is_told(asked, change, told):
    vars(asked).update(change)
    with pytest.raises(StationError, match="no relay for video.*" + told):
        relays_of(asked, **DEPLOYED).servers()


def test_no_server_is_no_error_and_is_not_kept(asked):
    asked.servers = []
    relays = relays_of(asked, **DEPLOYED)
    assert relays.servers() == relays.servers() == [STUN]
    assert len(asked.made) == 4
