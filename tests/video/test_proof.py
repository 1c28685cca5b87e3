"""What a driver saw, and that no command passes when the picture froze: the page in a browser, and an aiortc
receiver, on networks with delay, loss, a narrow line and cuts.

Delays are told beside their targets; what is asserted are rules: every command that passed was given by a
picture that was on the screen and was not late, and pictures come again. IORT_VIDEO_S sets the duration, see
`make prove-video`.
"""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

import pytest

from local.cloud import EmbeddedCloud
from testkit.machine import describe
from tests.local.conftest import embedded  # noqa: F401 - a fixture
from tests.video.proof import AIORTC, CHROMIUM, NETWORK, NO_UDP, Proof
from tests.video.report import kept, report
from tests.video.scene import Scene

pytestmark = pytest.mark.heavy

DURATION_S = float(os.environ.get("IORT_VIDEO_S") or 30)
# Ten minutes have the fifty tries of each failure.
TRIES = max(3, min(50, round(DURATION_S / 12)))


@pytest.fixture(scope="module")
def proof(
    request: pytest.FixtureRequest,
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    tmp_path_factory: pytest.TempPathFactory,
) -> Proof:
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    folder = tmp_path_factory.mktemp("video")
    manager = request.config.pluginmanager.getplugin("capturemanager")

    def say(line: str) -> None:
        with manager.global_and_fixture_disabled():
            print(line, flush=True)  # noqa: T201 - the proof's progress and result

    with Scene(embedded, folder, say=say) as scene:
        made = Proof(scene, folder, DURATION_S, TRIES, say)
        made.run()
    say(f"\n{report(made.figures)}")
    if path := os.environ.get("IORT_VIDEO_REPORT"):
        kept({"machine": describe(), "duration_s": DURATION_S, **asdict(made.figures)}, Path(path))
    return made


def test_no_command_passes_by_a_late_picture_or_by_none(proof: Proof) -> None:
    whole = proof.figures.whole
    assert whole is not None
    assert whole.wrong == ()
    assert whole.passed > 0


def test_none_passes_after_the_picture_froze(proof: Proof) -> None:
    for one in proof.figures.tries:
        assert one.verdict is not None
        assert one.verdict.wrong == ()
        # There was something to stop.
        assert one.driven > 0


def test_every_failure_was_tried(proof: Proof) -> None:
    counts = {one.failure: 0 for one in proof.figures.tries}
    for one in proof.figures.tries:
        counts[one.failure] += 1
    assert len(counts) == (4 if proof.scene.wire is not None else 3), counts
    assert set(counts.values()) == {TRIES}
    assert (NETWORK in counts) == (proof.scene.wire is not None)


def test_the_picture_is_back_after_every_cut_and_failure(proof: Proof) -> None:
    assert all(again is not None for ends in proof.figures.recovery_s.values() for again in ends)
    assert all(one.again_s is not None for one in proof.figures.tries)


def test_a_bad_network_gives_fewer_pictures_and_some_of_them_live(proof: Proof) -> None:
    for one in proof.figures.bad:
        assert one["pictures_hz"] > 0, one
        assert one["live_share"] > 0, one


def test_without_udp_the_car_is_seen_and_driven_over_the_broker(proof: Proof) -> None:
    if proof.scene.wire is None:
        pytest.skip("no network between machines here")
    (one,) = [each for each in proof.figures.bad if each["network"] == NO_UDP]
    assert one["pictures_hz"] > 0
    assert proof.figures.by_broker > 0


def test_both_viewers_read_the_number_in_the_picture(proof: Proof) -> None:
    assert set(proof.figures.glass) == {CHROMIUM, AIORTC}
    assert all(spread.n > 0 for viewer in proof.figures.glass.values() for spread in viewer.values())
    assert all(proof.figures.stats.values())
