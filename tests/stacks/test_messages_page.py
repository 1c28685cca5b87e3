"""docs/reference/messages.md names the contract's topics and the permissions of the policies."""

from __future__ import annotations

import re

from aws_cdk import Stack

from iort_contract.cloud import claim_name
from iort_contract.messages.live import lease_topic
from iort_contract.topics import (
    ANSWER,
    ASK,
    CMD,
    FILE,
    FLEET,
    LAMBDA,
    LANES,
    LIVE,
    PING,
    PING_PATHS,
    PONG,
    RECORD,
    RULE,
    SHADOW,
    as_subscribed,
    build_topic,
    live_topic,
    record_topic,
    rule_name,
)
from stacks.fleet import claim_policy, robot_policy
from tests.messages_page import named, rows, section
from tests.policy import allows

ME = "car7"
PLACES = {"<robot>": ME, "<stream>": "arm", "<name>": "drive"}
ACTIONS = {"publishes": [("Publish", "topic")], "hears": [("Subscribe", "topicfilter"), ("Receive", "topic")]}


def told(title):
    """The filled-in topics of a table, with the robot's actions on them."""
    found = {}
    for row in rows(section(title).split("subscribe to both answers")[-1]):
        (topic,) = named(row[0])
        for place, value in PLACES.items():
            topic = topic.replace(place, value)
        found[topic] = row[1].split(", ")
    return found


def plain(topic):
    """Without Basic Ingest's prefix."""
    return as_subscribed(as_subscribed(topic, rule_name("record")), rule_name("live"))


def allowed(document, topic, does):
    variables = {"iot:Connection.Thing.ThingName": ME, "iot:Connection.Thing.IsAttached": "true"}
    return all(
        allows(statements(document), f"iot:{action}", f"arn:aws:iot:eu-west-1:1:{kind}/{topic}", variables)
        for action, kind in ACTIONS[does]
    )


def statements(document):
    """The statements with the ARNs of one account; the stack leaves them open."""
    for statement in document["Statement"]:
        names = [re.search(r"(topic|topicfilter|client)/.*", arn)[0] for arn in statement["Resource"]]
        yield {**statement, "Resource": [f"arn:aws:iot:eu-west-1:1:{name}" for name in names]}


def test_a_robot_has_the_permissions_of_the_table():
    document, topics = robot_policy(Stack(), namespace="iort"), told("## Topics")
    for topic, does in topics.items():
        for what in does:
            assert allowed(document, topic, what), (topic, what)
        lane = plain(topic).split("/")[0]
        if lane in (CMD, PONG, ANSWER):
            assert not allowed(document, topic, "publishes"), topic
        if lane in (RECORD, LIVE, ASK):
            assert not allowed(document, topic, "hears"), topic


def test_the_table_has_every_topic_of_the_contract():
    topics = told("## Topics")
    ours = {topic for topic in topics if not topic.startswith("$aws/things/")}
    assert ours == {
        record_topic(ME, "arm"),
        live_topic(ME, "arm"),
        build_topic("live", ME, "arm"),
        *(build_topic(PING, ME, path) for path in (*PING_PATHS, FILE)),
        *(build_topic(PONG, ME, path) for path in (RULE, LAMBDA, FILE)),
        build_topic(CMD, ME, "drive"),
        lease_topic(ME, "iort"),
        build_topic(ASK, ME, "drive"),
        build_topic(ANSWER, ME, "drive"),
        build_topic(FLEET, ME, "drive"),
        f"{FLEET}/iort/+/drive",
    }
    assert {plain(topic).split("/")[0] for topic in ours} == set(LANES)
    shadow = f"$aws/things/{ME}/shadow/name/{SHADOW}"
    answers = [
        f"{shadow}/{verb}{answer}" for verb in ("get", "update") for answer in ("", "/accepted", "/rejected")
    ]
    assert topics.keys() - ours == set(answers)


def test_a_claim_has_exactly_the_permissions_of_the_table():
    document, topics = claim_policy(Stack(), namespace="iort"), told("## Provisioning")
    assert len(topics) == 6
    for topic, (does,) in topics.items():
        other = ({*ACTIONS} - {does}).pop()
        assert allowed(document, topic, does), topic
        assert not allowed(document, topic, other), topic
    assert f"`{claim_name('iort')}-`" in section("## Provisioning")
