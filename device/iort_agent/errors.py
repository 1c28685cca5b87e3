"""Every error of the agent. The rooms wrap errors of libraries, `from` their cause."""

from __future__ import annotations


class AgentError(Exception):
    """Root of the agent's errors; its text is meant for the person who runs the robot."""


class ConfigError(AgentError):
    """A mistake in the configuration; the text names file, key, value and what is allowed."""


class NotRunningError(AgentError):
    """No agent answers on the status socket."""


class BusyError(AgentError):
    """The running agent has not answered on the status socket in time."""


class SourceError(AgentError):
    """A source cannot give samples, or cannot give more of them."""


class UplinkError(AgentError):
    """The connection, a publish or a subscription failed; the text quotes the broker."""


class IdentityError(AgentError):
    """Certificate or key cannot be used or obtained; the text names the file, or who refused."""


class RefusedError(IdentityError):
    """AWS IoT refused to issue or register a certificate; ``code`` is AWS' error code."""

    def __init__(self, text: str, code: str) -> None:
        super().__init__(text)
        self.code = code


class UploadError(AgentError):
    """A file cannot be uploaded; the text names the file and quotes the cloud or the file system.

    The upload is worth another try after ``again_s`` seconds. None: only after the file has changed.
    """

    def __init__(self, text: str, *, again_s: float | None) -> None:
        super().__init__(text)
        self.again_s = again_s


class VideoError(AgentError):
    """A camera or the encoder cannot work, or not now; the text says what to do."""


class AskError(AgentError):
    """A question to the cloud has no answer; ``reason`` is the cloud's word for why, or the agent's."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason
