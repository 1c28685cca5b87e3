"""What of a viewer's offer reaches WebRTC."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.video.offers import MAX_CANDIDATES, MAX_LINE_CHARACTERS, MAX_LINES, bounded, of_deployment
from iort_contract.limits import ContractError
from iort_contract.messages.video import IceServer

VIDEO, DATA = "m=video 9 UDP/TLS/RTP/SAVPF 96", "m=application 9 UDP/DTLS/SCTP webrtc-datachannel"
HOST = "a=candidate:1 1 udp 2122260223 192.0.2.1 5000 typ host"
HIDDEN = "a=candidate:2 1 udp 2122260223 5b5ff5ae-0000-4000-8000-000000000000.local 5001 typ host"


def offer(*lines: str) -> str:
    return "\r\n".join(["v=0", "s=-", *lines]) + "\r\n"


def test_an_offer_is_kept_but_for_hidden_addresses_and_the_end_of_the_list() -> None:
    sdp = offer(VIDEO, HOST, HIDDEN, "a=end-of-candidates", DATA)
    assert bounded(sdp) == offer(VIDEO, HOST, DATA)


@pytest.mark.parametrize("host", ["192.168.1.5", "127.0.0.1", "::1", "fe80::1", "2001:db8::1"])
def test_the_address_of_a_host_is_kept(host: str) -> None:
    sdp = offer(VIDEO, HOST.replace("192.0.2.1", host))
    assert bounded(sdp) == sdp


@pytest.mark.parametrize(
    "host", ["router.lan", "239.255.0.1", "255.255.255.255", "0.0.0.0", "::", "ff02::1", "x.LOCAL", "1.2.3"]
)
def test_the_robot_looks_up_no_name_and_asks_no_group_of_hosts(host: str) -> None:
    assert bounded(offer(VIDEO, HOST.replace("192.0.2.1", host))) == offer(VIDEO)


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        ([VIDEO] * 2, "one video"),
        ([DATA], "one video"),
        ([], "one video"),
        ([VIDEO, "m=audio 9 UDP/TLS/RTP/SAVPF 0"], "got 'video, audio'"),
        ([VIDEO, DATA, DATA], "at most one application"),
        ([VIDEO] * 500, "one video"),
        ([VIDEO] * 1000, f"at most {MAX_LINES} lines, got 1002"),
        ([VIDEO] + [HOST] * (MAX_CANDIDATES + 1), f"at most {MAX_CANDIDATES} candidates, got 49"),
        ([VIDEO] + ["a=candidate:"] * 10_000, f"at most {MAX_LINES} lines, got 10003"),
        ([VIDEO, "a=" + "x" * MAX_LINE_CHARACTERS], f"at most {MAX_LINE_CHARACTERS} characters"),
    ],
)
def test_an_offer_beyond_what_a_browser_makes_is_refused(lines: list[str], why: str) -> None:
    with pytest.raises(ContractError, match=why):
        bounded(offer(*lines))


@given(
    st.text(max_size=300) | st.lists(st.sampled_from([VIDEO, DATA, HOST, "a=candidate:", ""])).map("\n".join)
)
def test_any_text_is_bounded_or_refused(sdp: str) -> None:
    try:
        kept = bounded(sdp)
    except ContractError:
        return
    assert kept.count("m=video") == 1


@pytest.mark.parametrize(
    "url",
    [
        "stun:stun.kinesisvideo.eu-west-1.amazonaws.com:443",
        "turn:192-0-2-1.t-0a1b2c3d.kinesisvideo.eu-west-1.amazonaws.com:443?transport=udp",
        "turns:192-0-2-1.t-0a1b2c3d.kinesisvideo.us-gov-west-1.amazonaws.com:443?transport=tcp",
        "turns:192-0-2-1.t-0a1b2c3d.kinesisvideo.cn-north-1.amazonaws.com.cn:443?transport=tcp",
    ],
)
def test_a_deployments_servers_may_be_used(url: str) -> None:
    server = IceServer((url,), "user", "secret")
    assert of_deployment([server]) == (server,)


@pytest.mark.parametrize(
    "url",
    [
        "turn:example.com:3478",
        "turn:192.168.0.1:22",
        "turn:kinesisvideo.eu-west-1.amazonaws.com.example.com",
        "turn:evil.com/x.kinesisvideo.eu-west-1.amazonaws.com",
        "turn:evil.com?x.kinesisvideo.eu-west-1.amazonaws.com",
        "turn:user@x.kinesisvideo.eu-west-1.amazonaws.com",
        "turn:x.kinesisvideo.evil.com.eu-west-1.amazonaws.com",
        "turn:x.kinesisvideo..amazonaws.com",
        "turn:x.s3.eu-west-1.amazonaws.com",
        "stun:x.kinesisvideo.eu-west-1.amazonaws.com\n",
    ],
)
def test_a_viewer_cannot_send_the_robot_to_another_host(url: str) -> None:
    known = "stun:stun.kinesisvideo.eu-west-1.amazonaws.com:443"
    assert of_deployment([IceServer((url,)), IceServer((url, known))]) == (IceServer((known,)),)
