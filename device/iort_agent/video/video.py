"""Video of one run: it joins the camera, the encoder, the viewers, and what is kept of it.

| thread | does |
|---|---|
| `camera` | while somebody looks: takes and numbers pictures, encodes each once, sends some over the broker |
| `video` | answers viewers (`iort_agent.video.signalling`), and sends them what is encoded (`.sessions`) |

Between the threads is room for one picture: one that comes before the last was taken replaces it, and the
viewers wait for the next key picture. Nobody looks, and the camera is closed, the encoder is gone, and both
threads wait. Neither shares anything with commands but `Pictures`: if a thread fails, no newer pictures have
numbers, and so driving ends."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import threading
from collections import deque
from typing import Any, Callable, Iterable, Mapping, Sequence, TypeVar

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Supervised
from iort_agent.errors import VideoError
from iort_agent.mqtt.rate_limiter import LIVE
from iort_agent.mqtt.uplink import Link
from iort_agent.ros import Graph
from iort_agent.video import EXTRA, Encoded, Frame, Pictures, require
from iort_agent.video.camera import Camera, Pacer
from iort_agent.video.capture import Capture
from iort_agent.video.config import VP8, VideoConfig
from iort_agent.video.encoder import Encoder, make_encoder
from iort_agent.video.pictures import jpeg
from iort_agent.video.rate import Rate
from iort_agent.video.signalling import Demand, Session, Signalling
from iort_contract.catalog.streams import VIDEO_STREAM
from iort_contract.limits import ContractError, Value
from iort_contract.messages.video import IceServer, Picture, encode_picture, look_topic, picture_topic

_log = logging.getLogger(__name__)

T = TypeVar("T")
# Takes a sample for the record lane.
Record = Callable[[str, int, Mapping[str, Value]], object]

# No key pictures sooner: each has the bits of many others.
KEY_EVERY_S = 0.5
# The longest end of the thread `video`: a server that does not answer must not keep the agent from ending.
END_S = 8.0
# How long after a failure of the camera viewers are told of it, instead of what it can show.
AGAIN_S = 3.0
# The bitrate before a viewer has said what it can take.
_START_KBPS = 800.0
# A picture over the broker. Five a second of the largest are a fifth of what AWS allows a connection.
_WIDTH, _QUALITY, _MOST_BYTES = 320, 50, 20_000
_KEPT = 300


class Video:
    """Made before the uplink starts. `start` and `close` are called once.

    ``camera`` is asked when somebody looks for the first time, and gives what makes the camera whenever
    somebody begins to look. ``keep`` takes each picture for the recorder, if there is one. ``graph`` is the
    camera's. ``offset_us`` converts the robot's times to the cloud's, if it is known. ``first`` is the number
    of the first picture.
    """

    def __init__(
        self,
        config: VideoConfig,
        link: Link,
        pictures: Pictures,
        *,
        camera: Callable[[], Callable[[], Camera]],
        record: Record,
        encoder: Callable[[VideoConfig], Encoder] = make_encoder,
        keep: Callable[[Frame], object] | None = None,
        graph: Graph | None = None,
        offset_us: Callable[[], int | None] = lambda: None,
        first: int = 1,
    ) -> None:
        self._config, self._link, self._clock = config, link, link.clock
        self.terms = config.terms()
        self._camera, self._make_encoder, self._graph = camera, encoder, graph
        self._make_camera: Callable[[], Camera] | None = None
        self._record, self._keep, self._offset_us = record, keep, offset_us
        self._throttled = ThrottledLog(_log, link.clock)
        self._topic = picture_topic(link.robot, link.namespace)
        # What does not change before a restart.
        self._lacks: list[str] = []
        if importlib.util.find_spec("aiortc") is None:
            self._lacks.append(f"video: the package aiortc is missing: pip install '{EXTRA}'")
        self._signalling = Signalling(
            link,
            terms=self.terms,
            own=self._own_servers(),
            why_not=self._why_not,
            make=self._make_session,
            on_demand=self._on_demand,
        )
        link.uplink.subscribe(look_topic(link.robot, link.namespace), self._signalling.arrive)
        self._stop = threading.Event()
        self._demand = Demand()
        self._encoder: Encoder | None = None
        # The picture between the threads, and whether one was replaced there.
        self._lock = threading.Lock()
        self._handed: Encoded | None = None
        self._missed = False
        # Whether a viewer has connected, and whether one needs a key picture.
        self._begun = self._wants_key = False
        self._keyed_at = float("-inf")
        self._kbps = self._start_kbps()
        self._pacer = Pacer(config.pictures_hz)
        # What is wrong with the camera, and when it is tried again.
        self._trouble, self._again_at = "", 0.0
        self.published = self.held_back = 0
        self._encode_ms: deque[float] = deque(maxlen=_KEPT)
        self._sent_ms: deque[float] = deque(maxlen=_KEPT)
        self._capture = Capture(
            self._make_watched, link.clock, take=self._on_frame, pictures=pictures, first=first
        )
        self._thread = Supervised("video", self._run)

    def start(self) -> None:
        """Begin to answer viewers."""
        if self._graph is not None:
            self._graph.start()
        self._capture.start()
        self._thread.start()

    def close(self) -> None:
        """End every session and both threads."""
        self._stop.set()
        self._signalling.wake()
        self._thread.join(END_S)
        if self._thread.is_alive():
            _log.error("video: its thread does not end, and is left behind")
        self._capture.close()
        if self._graph is not None:
            self._graph.close()

    def alarms(self) -> list[str]:
        """What is wrong with it."""
        return self._lacks

    def report(self) -> dict[str, Any]:
        """Its counts, for the status."""
        signalling, encoder = self._signalling, self._encoder
        report: dict[str, Any] = {
            **self._demand._asdict(),
            "bitrate_kbps": round(self._kbps) if encoder is not None else 0,
            **self._capture.report(),
            "over the broker": self.published,
            "held back": self.held_back,
            "requests dropped": signalling.dropped,
            "malformed": signalling.malformed,
            "refused": signalling.refused,
        }
        if encoder is not None:
            report["encoder"] = dict(encoder.report())
            report["encoded within ms"] = _percentiles(self._encode_ms)
            report["sent within ms"] = _percentiles(self._sent_ms)
        return report

    # --- the thread `video` ----------------------------------------------------------------------------

    def _run(self) -> None:
        with self._lock:
            self._handed, self._missed = None, True
        asyncio.run(self._signalling.run(self._stop.is_set))

    def _own_servers(self) -> Sequence[IceServer]:
        try:
            return [self._config.turn.server()] if self._config.turn is not None else []
        except VideoError as error:
            self._lacks.append(f"video.turn: {error}")
            return []

    def _why_not(self) -> str:
        try:
            from iort_agent.video import sessions  # noqa: F401, PLC0415 - only somebody who looks costs its memory

            require("PIL.Image")
        except (ImportError, VideoError) as error:
            return f"the robot has not the package for video: pip install '{EXTRA}' ({error})"
        return self._trouble if self._clock.monotonic() < self._again_at else ""

    def _start_kbps(self) -> float:
        bounds = self._config.bitrate_kbps
        return float(max(bounds.min, min(bounds.max, _START_KBPS)))

    def _make_session(self, servers: Sequence[IceServer], on_end: Callable[[str], object]) -> Session:
        from iort_agent.video.sessions import Session as WebRtc  # noqa: PLC0415 - as above

        bounds = self._config.bitrate_kbps
        return WebRtc(
            servers,
            codec=VP8 if self._config.codec == VP8 else "h264",
            clock=self._clock,
            rate=Rate(self._start_kbps() * 1e3, bounds.min * 1e3, bounds.max * 1e3),
            on_key=self._want_key,
            on_sent=self._sent_ms.append,
            on_end=on_end,
        )

    def _on_demand(self, demand: Demand) -> None:
        self._demand = demand
        if not demand.viewers:
            self._begun = self._wants_key = False
        self._capture.want(wanted=any(demand))

    def _want_key(self) -> None:
        self._begun = self._wants_key = True

    def _show(self) -> None:
        """Give the newest picture to all sessions."""
        from iort_agent.video.sessions import packed  # noqa: PLC0415 - as above

        with self._lock:
            encoded, missed = self._handed, self._missed
            self._handed, self._missed = None, False
        if encoded is None:
            return
        sessions = self._signalling.sessions()
        picture = packed(encoded)
        for session in sessions:
            if missed:
                session.missed()
            session.show(picture)
        self._kbps = min((session.rate.bps() / 1000 for session in sessions), default=self._start_kbps())

    # --- the thread `camera` ---------------------------------------------------------------------------

    def _make_watched(self) -> Camera:
        try:
            if self._make_camera is None:
                self._make_camera = self._camera()
            camera = self._make_camera()
        except Exception as error:
            self._fail(error)
            raise
        return _Watched(camera, failed=self._fail, closed=self._forget_encoder)

    def _fail(self, error: Exception) -> None:
        known = isinstance(error, VideoError)
        # A mistake may pass at once: only the next one without a picture between ends the sessions.
        ends, why = known or self._trouble, "" if known else f"{type(error).__name__}: "
        trouble = f"the camera does not work: {why}{error}"
        self._throttled.warn("camera", f"video: {trouble}")
        self._trouble, self._again_at = trouble, self._clock.monotonic() + AGAIN_S
        if ends:
            self._signalling.post(lambda: self._signalling.end_all(trouble))

    def _forget_encoder(self) -> None:
        encoder, self._encoder = self._encoder, None
        if encoder is not None:
            encoder.close()

    def _on_frame(self, frame: Frame) -> None:
        try:
            self._take(frame)
        except Exception as error:
            self._fail(error)
            raise

    def _take(self, frame: Frame) -> None:
        demand = self._demand
        values: dict[str, Value] = {}
        if demand.viewers:
            values = self._encode(frame)
        elif self._encoder is not None:
            self._forget_encoder()
        if demand.watchers and self._pacer.takes(frame.monotonic):
            published = self._publish(frame)
            values = values or published
        self._trouble = ""
        if not values:
            return
        if self._keep is not None:
            self._keep(frame)
        self._record(
            VIDEO_STREAM,
            frame.captured_us,
            {"frame": frame.number, **values, "viewers": demand.viewers, "watchers": demand.watchers},
        )

    def _encode(self, frame: Frame) -> dict[str, Value]:
        """Encode a picture and hand it over; what is recorded of it, nothing if it was left out."""
        encoder = self._encoder
        if encoder is None:
            if not self._begun:
                return {}
            encoder = self._encoder = self._make_encoder(self._config)
        kbps = self._kbps
        encoder.set_bitrate(kbps)
        key = self._wants_key and frame.monotonic - self._keyed_at >= KEY_EVERY_S
        if key:
            self._wants_key = False
        encoded = encoder.encode(frame, key=key)
        if encoded is None:
            # A key picture that was left out is still wanted.
            self._wants_key = self._wants_key or key
            return {}
        if key or encoded.key:
            self._keyed_at = frame.monotonic
        encode_ms = (self._clock.monotonic() - frame.monotonic) * 1000
        self._encode_ms.append(encode_ms)
        with self._lock:
            self._missed = self._missed or self._handed is not None
            self._handed = encoded
        # Always: a thread that starts again may have lost the last one.
        self._signalling.post(self._show)
        return {
            "bytes": len(encoded.data),
            "key": encoded.key,
            "encode_ms": round(encode_ms, 1),
            "bitrate_kbps": round(kbps),
        }

    def _publish(self, frame: Frame) -> dict[str, Value]:
        """Send a picture over the broker; as `_encode`."""
        content = jpeg(frame.picture, quality=_QUALITY, width=_WIDTH, most_bytes=_MOST_BYTES)
        encode_ms = (self._clock.monotonic() - frame.monotonic) * 1000
        picture = Picture(frame.number, frame.captured_us, self._clock.now_us(), self._offset_us(), content)
        try:
            payload = encode_picture(picture)
        except ContractError as error:
            self._throttled.warn("picture", f"video: a picture is not sent: {error}")
            return {}
        if not self._link.rate_limiter.may_go(LIVE, self._topic, len(payload)):
            self.held_back += 1
            return {}
        self._link.publish(self._topic, payload, qos=0)
        self.published += 1
        return {"bytes": len(content), "key": True, "encode_ms": round(encode_ms, 1), "bitrate_kbps": None}


class _Watched(Camera):
    """A camera that tells what goes wrong with it, and when it is closed."""

    def __init__(
        self, camera: Camera, *, failed: Callable[[Exception], object], closed: Callable[[], object]
    ) -> None:
        self._camera, self._failed, self._closed = camera, failed, closed

    def open(self) -> None:
        self._tried(self._camera.open)

    def read(self, number: int, stop: threading.Event) -> Frame | None:
        return self._tried(lambda: self._camera.read(number, stop))

    def report(self) -> Mapping[str, Any]:
        return self._camera.report()

    def close(self) -> None:
        try:
            self._closed()
        finally:
            self._camera.close()

    def _tried(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except Exception as error:
            self._failed(error)
            raise


def _percentiles(values: Iterable[float]) -> dict[str, float]:
    ordered = sorted(values)
    if not ordered:
        return {}
    return {f"p{p}": round(ordered[min(len(ordered) - 1, len(ordered) * p // 100)], 1) for p in (50, 95)}
