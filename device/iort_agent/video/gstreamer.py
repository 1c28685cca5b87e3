"""H.264 by a pipeline of GStreamer, for a hardware encoder such as a Jetson's. Not tried on a Jetson.

The pipeline runs in a process of its own, `gst-launch-1.0`: raw pictures go to its standard input, and
access units come from its standard output, each framed by GStreamer's data protocol, so that none waits for
the next. Nothing of GStreamer is loaded into the agent.

gst-launch takes no orders while it runs. Another bitrate, or a key picture that the pipeline does not make by
itself within `_KEY_S`, is had by another process."""

from __future__ import annotations

import os
import select
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import suppress
from typing import IO, Any, Mapping

from iort_agent.errors import VideoError
from iort_agent.video import Encoded, Frame
from iort_agent.video.config import VideoConfig
from iort_agent.video.pictures import packed

PROGRAM = "gst-launch-1.0"
# GStreamer's data protocol: a head with the kind and the length of what follows.
_HEAD, _KIND, _LENGTH, _BUFFER = 62, slice(4, 6), slice(6, 10), 1
_MOST_BYTES = 8_000_000
# A process that starts loads its elements; later a picture may take so long.
_BEGIN_S, _PICTURE_S = 10.0, 1.0
_KEY_S, _CHANGE, _CHANGE_S = 2.0, 0.2, 5.0
_READ = 65_536
# The kinds of H.264's units.
_START, _IDR, _KINDS = b"\x00\x00\x01", 5, 0x1F


class GstreamerEncoder:
    """Encodes by ``config.pipeline``. Raises `VideoError` without gst-launch."""

    def __init__(self, config: VideoConfig) -> None:
        program = shutil.which(PROGRAM)
        if program is None:
            raise VideoError(
                f"codec: gstreamer needs {PROGRAM}: apt install gstreamer1.0-tools gstreamer1.0-plugins-bad"
            )
        self._program, self._config = program, config
        self._kbps = self._aim = config.bitrate_kbps.max
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._buffer = bytearray()
        self._opened = self._keyed = 0.0
        self._within_s = _BEGIN_S
        self.encoded = self.started = 0

    def set_bitrate(self, kbps: float) -> None:
        """As `iort_agent.video.encoder.Encoder`."""
        bounds = self._config.bitrate_kbps
        self._aim = round(max(bounds.min, min(bounds.max, kbps)))

    def encode(self, frame: Frame, *, key: bool = False) -> Encoded | None:
        """As `iort_agent.video.encoder.Encoder`."""
        began, now = time.perf_counter(), frame.monotonic
        other = abs(self._aim - self._kbps) > self._kbps * _CHANGE and now - self._opened > _CHANGE_S
        if self._process is None or other or (key and now - self._keyed > _KEY_S):
            self._start(now)
        try:
            unit = self._exchange(packed(frame.picture))
        except (OSError, VideoError) as error:
            why = self._told()
            self.close()
            raise VideoError(f"the pipeline {self._config.pipeline!r} failed: {why or error}") from error
        self._within_s, is_key = _PICTURE_S, _has_key(unit)
        if is_key:
            self._keyed = now
        self.encoded += 1
        return Encoded(frame, unit, is_key, (time.perf_counter() - began) * 1000)

    def report(self) -> Mapping[str, Any]:
        """As `iort_agent.video.encoder.Encoder`."""
        return {"encoded": self.encoded, "processes": self.started, "kbps": self._kbps}

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        self._buffer.clear()
        if process is not None:
            # Its group is its own.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            for pipe in (process.stdin, process.stdout, self._errors):
                if pipe is not None:
                    with suppress(OSError):
                        pipe.close()

    def _command(self) -> list[str]:
        config = self._config
        values = {"{kbps}": self._kbps, "{bps}": self._kbps * 1000, "{rate}": round(config.rate_hz)}
        pipeline = config.pipeline or ""
        for name, value in values.items():
            pipeline = pipeline.replace(name, str(value))
        size = f"format=i420 width={config.width} height={config.height}"
        return [
            self._program,
            "-q",
            *("fdsrc", "!", "rawvideoparse", *size.split(), f"framerate={round(config.rate_hz)}/1", "!"),
            *shlex.split(pipeline),
            *("!", "h264parse", "config-interval=-1", "!"),
            *("video/x-h264,stream-format=byte-stream,alignment=au", "!", "gdppay", "!"),
            *("fdsink", "sync=false"),
        ]

    def _start(self, now: float) -> None:
        self.close()
        self._kbps, self._opened, self._keyed, self._within_s = self._aim, now, now, _BEGIN_S
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - the method close closes it
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the owner of car.yaml chose the pipeline; no shell
                self._command(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            raise VideoError(f"{PROGRAM} cannot be started: {error}") from error
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None, "as above"
            os.set_blocking(pipe.fileno(), False)
        self.started += 1

    def _exchange(self, picture: bytes) -> bytes:
        """Give a picture, and get its access unit. Raises `VideoError` and `OSError`."""
        process = self._process
        assert process is not None, "as `encode` starts it"
        assert process.stdin is not None, "as above"
        assert process.stdout is not None, "as above"
        left, until = memoryview(picture), time.monotonic() + self._within_s
        while True:
            unit = self._unit()
            if unit is not None and not left:
                return unit
            wait_s = until - time.monotonic()
            ready, free, _ = select.select(
                [process.stdout], [process.stdin] if left else [], [], max(0.0, wait_s)
            )
            if free:
                left = left[os.write(process.stdin.fileno(), left) :]
            if ready:
                content = os.read(process.stdout.fileno(), _READ)
                if not content:
                    raise VideoError("it has ended")
                self._buffer += content
            elif not free:
                raise VideoError("it keeps pictures back: its encoder must give each at once")

    def _unit(self) -> bytes | None:
        """The next access unit, if it is there as a whole."""
        buffer = self._buffer
        while len(buffer) >= _HEAD:
            end = _HEAD + int.from_bytes(buffer[_LENGTH], "big")
            if end > _MOST_BYTES:
                raise VideoError("its output is not GStreamer's data protocol")
            if len(buffer) < end:
                return None
            kind, content = int.from_bytes(buffer[_KIND], "big"), bytes(buffer[_HEAD:end])
            del buffer[:end]
            # Before it come events and formats.
            if kind == _BUFFER:
                return content
        return None

    def _told(self) -> str:
        """The last line that GStreamer told of an error."""
        if self._errors is None:
            return ""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").splitlines()
        return next((line for line in lines if "err" in line.lower()), "")[:300]


def _has_key(unit: bytes) -> bool:
    at = unit.find(_START)
    while at >= 0 and at + len(_START) < len(unit):
        if unit[at + len(_START)] & _KINDS == _IDR:
            return True
        at = unit.find(_START, at + len(_START))
    return False
