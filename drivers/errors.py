"""Errors of a link. The command line turns each into its exit code."""

from drivers.texts import hide_all, printable


class DriverError(Exception):
    """The link failed: nobody there, silent, dropped, or another protocol.

    The message may quote the far end: it is one line, cut, and has neither control characters nor passwords.
    """

    exit_code = 4

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(hide_all(str(message))))

    @property
    def asks(self) -> bool:
        """Whether the message ends in a question, so that advice after it begins a sentence."""
        return str(self).endswith("?")


class ProtocolError(DriverError):
    """The far end does not speak this protocol, or sent a damaged frame."""


class RefusedError(DriverError):
    """The controller understood and refused; the message holds its reason."""


class SafetyRefused(RefusedError):
    """The controller refused because its emergency stop is pressed."""

    exit_code = 5


class MotionStopped(DriverError):
    """The arm was stopped while it moved: E-stop, drive fault, protective stop or a changed override."""

    exit_code = 5


class LinkStopped(MotionStopped):
    """The driver stopped the arm while it moved, as what it hears or says can no longer be trusted."""

    exit_code = 4


class ConfigurationError(DriverError):
    """The recipe asks for a driver that there is not, or gives an address that none could use."""

    exit_code = 2
