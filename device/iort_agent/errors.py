"""Every error of the agent. Errors of libraries are wrapped at the adapter, `from` their cause.

AgentError
ConfigError    the configuration file says something it may not
SourceError    a source cannot give samples (a bag unreadable, a type unknown)
UplinkError    the broker cannot be reached, or refused a message
IdentityError  certificate or key cannot be read, do not belong together, or cannot be had
 RefusedError  AWS IoT refuses to issue or register a certificate
UploadError    a file cannot be uploaded
NotRunningError no agent answers on the status socket
"""

from __future__ import annotations


class AgentError(Exception):
    """Root of the agent's errors; its text is meant for the person who runs the robot."""


class ConfigError(AgentError):
    """A mistake in the configuration; the text names file, key, what was found and what is allowed."""


class NotRunningError(AgentError):
    """No agent answers on the status socket."""


class SourceError(AgentError):
    """A source cannot give samples, or no more of them."""


class UplinkError(AgentError):
    """The connection, a publish or a subscription failed; the text has the broker's own words."""


class IdentityError(AgentError):
    """Certificate or key cannot be used or obtained; the text says which file, or who refused."""


class RefusedError(IdentityError):
    """AWS IoT refused to issue or register a certificate; ``code`` is its own."""

    def __init__(self, text: str, code: str) -> None:
        super().__init__(text)
        self.code = code


class UploadError(AgentError):
    """A file cannot be uploaded; the text says which, and what the cloud or the file system said.

    ``again_s`` is after how many seconds it is worth another try; None: never, as it is.
    """

    def __init__(self, text: str, *, again_s: float | None) -> None:
        super().__init__(text)
        self.again_s = again_s
