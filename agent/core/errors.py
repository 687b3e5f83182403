"""The errors a user meets. Each carries the exit code of the command line (0 is the absence of an error)."""

import errno

#: System errors of a disk or folder that is full or read-only: exit code 1, while a folder that is missing gives 2.
FULL_OR_READ_ONLY = (errno.EACCES, errno.EDQUOT, errno.EFBIG, errno.ENOSPC, errno.EPERM, errno.EROFS)


class AgentError(Exception):
    """Something the user can act on: the message says what, where, which limit and what to do."""

    exit_code = 1


class InputError(AgentError):
    """Bad usage, recipe, robot description, log or model file."""

    exit_code = 2


class RejectedError(AgentError):
    """The job ran, but its gate rejected the result."""

    exit_code = 3


class ControllerError(AgentError):
    """Nobody there, silent, wrong protocol, or the wrong robot, mode or program before motion."""

    exit_code = 4


class MismatchError(ControllerError):
    """A controller that is not what the recipe says: another robot, other joints, another sampling rate."""


class SafetyError(AgentError):
    """E-stop, drive fault, protective stop or a changed override while moving."""

    exit_code = 5


class BusyError(AgentError):
    """Another run holds the robot's lock."""

    exit_code = 75
