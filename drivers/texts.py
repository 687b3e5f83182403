"""Text that came from elsewhere, made fit for a terminal, a log and a page: no passwords, no control characters."""

from __future__ import annotations

import re

#: Characters of a name or a serial, of an alarm, and of an error's message that come from a controller.
NAME, ALARM, MESSAGE = 128, 300, 2000
#: Alarms and joints that a controller may report.
MANY = 64
#: Passwords that this process has read, in every form in which they may stand in a text.
hidden_forms: set[str] = set()

#: C0 and C1 controls except line feed and tab, marks of the writing direction, and halves of characters.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
#: ANSI: a command (CSI), a string (OSC, DCS, …) with its end, or another two characters.
_ESCAPE = re.compile(
    "(?:\x1b\\[|\x9b)[0-?]*[ -/]*[@-~]|(?:\x1b[]PX^_]|[\x90\x98\x9d-\x9f])[^\x07\x1b\x9c]*(?:\x07|\x1b\\\\|\x9c)|\x1b."
)
_IN_ADDRESS = re.compile(r"(?P<user>[^\s/@,:'\"{}()=]*:)[^\s@/'\"{};]+@(?=[\w\[])")
_KEYS = "pass(?:word|wd|phrase)?|pwd|secret|token|api_?key"
_IN_OPTION = re.compile(rf"(?i)(?<![a-z])(?P<key>{_KEYS})=(?!\*)[^\s,;'\"&<>}}]+")
_HIDDEN = "***"
_IP = re.compile(r"[0-9A-Fa-f]{0,4}(?::[0-9A-Fa-f]{0,4}){2,7}")
#: Where an address leads: a device, or a host with its port.
_TARGET = re.compile(
    r"ros2://[\w/]*|/(?:[\w./+~-]|:(?=\d))*|\\\\\.\\\w+|(?:[a-z]+://)?(?:\[[\w:.%]+\]|[\w.-]*)(?::0*\d{1,5}(?!\w))?",
    re.ASCII,
)


def public_address(address: str) -> str:
    """The target of an address, for people. Its options are not shown, whatever their names: one may be a password."""
    text = printable(address, NAME)
    head = re.split(r"[,;?#&\s]", text, maxsplit=1)[0]
    match = None if "@" in text or "=" in head else _IP.fullmatch(head) or _TARGET.match(head)
    target = match[0] if match else ""
    return target if target == text else f"{target},…"


def hide(text: str) -> str:
    """The text without any password that this process has read."""
    for secret in sorted(hidden_forms, key=len, reverse=True):
        text = text.replace(secret, _HIDDEN)
    return text


def hide_all(text: str) -> str:
    """The text without passwords that were read, and without what stands where an address or an option has one."""
    text = _IN_ADDRESS.sub(rf"\g<user>{_HIDDEN}@", hide(text))
    return _IN_OPTION.sub(rf"\g<key>={_HIDDEN}", text)


def printable(text: object, longest: int = MESSAGE, lines: bool = False) -> str:
    """A text without control characters and terminal commands, cut to at most `longest` characters.

    Args:
        lines: whether line feeds may stay; they become blanks otherwise.
    """
    whole = str(text)
    cut = whole[: 4 * longest]  # limits the search for commands
    cut = _CONTROL.sub("", _ESCAPE.sub("", cut.replace("\r\n", "\n").replace("\r", "\n")))
    if not lines:
        cut = cut.replace("\n", " ").replace("\t", " ")
    return cut if len(cut) <= longest and len(whole) <= 4 * longest else f"{cut[: longest - 1]}…"
