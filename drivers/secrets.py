"""Reads passwords from where they are stored, and registers them so that no shown or stored text contains them.

An address names where a password is stored, never the password: `env:NAME`, `file:PATH` or `keyring:SERVICE/USER`.
"""

from __future__ import annotations

import html
import json
import os
import re
import stat
from urllib.parse import quote

from drivers.errors import ConfigurationError, DriverError
from drivers.texts import hidden_forms

#: Bytes of a file with a password.
_LONGEST = 4096
#: A shorter password is refused: it could not be distinguished from ordinary text.
_SHORTEST = 4
_OPTION = re.compile(r"(?i)(?<![a-z])(pass(?:word|wd|phrase)?|pwd|pw|secret|token|api_?key)\s*=")
_USER = re.compile(r":[^@]*@")
_PLACE = re.compile(r"(?i)(?<![^,\s])\w*password_from\s*=[^,]*")
ADVICE = (
    "a password does not belong in an address, which is printed and kept; name its place instead, like "
    "password_from=env:NAME, password_from=file:PATH (readable by you alone) or password_from=keyring:SERVICE/USER"
)


def refuse_in_address(address: str) -> None:
    """Check that the address of a driver holds no password.

    Raises:
        ConfigurationError: it holds one. The message says where to store it, and does not repeat it.
    """
    remainder = _PLACE.sub("", address)
    if _OPTION.search(remainder) or _USER.search(remainder):
        raise ConfigurationError(f"the address holds a password; {ADVICE}")


def check_source(source: str) -> str:
    """Check the password source named in an address.

    Raises:
        ValueError: it is none of the three kinds. The text is not repeated because it may be a password.
    """
    kind, colon, name = source.partition(":")
    if kind not in _KINDS or not colon or not name:
        raise ValueError("env:NAME, file:PATH or keyring:SERVICE/USER is expected")
    return source


def read_secret(source: str) -> str:
    """Read the password; from now on `drivers.texts.hide` removes it from every text.

    Raises:
        ConfigurationError: there is none, others can read it, or it is too short to be removed from texts.
    """
    kind, _, name = check_source(source).partition(":")
    secret = _KINDS[kind](name)
    if len(secret) < _SHORTEST:
        raise ConfigurationError(f"the password in {kind}:… has fewer than {_SHORTEST} characters; choose a longer one")
    if not secret.isprintable():
        raise ConfigurationError(f"the password in {kind}:… has characters that cannot be typed; one line is expected")
    hidden_forms.update({secret, json.dumps(secret)[1:-1], html.escape(secret), repr(secret)[1:-1], quote(secret)})
    return secret


def _from_environment(name: str) -> str:
    secret = os.environ.get(name)
    if secret is None:
        raise ConfigurationError("env:…: the environment has no such variable for the password; export it")
    return secret


def _from_file(name: str) -> str:
    try:
        with open(os.open(name, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise ConfigurationError("file:…: not a file, so no password is read from it")
            if about.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise ConfigurationError("file:…: others than its owner can read this password; chmod 600 that file")
            if about.st_uid not in (os.geteuid(), 0):
                raise ConfigurationError("file:…: this password belongs to another user; chown it")
            data = file.read(_LONGEST + 1)
    except OSError as error:
        raise ConfigurationError(f"file:…: the password cannot be read: {error.strerror}") from None
    if len(data) > _LONGEST:
        raise ConfigurationError(f"file:…: longer than {_LONGEST} bytes, which is no password")
    try:
        return data.decode("utf-8").strip("\r\n")
    except UnicodeDecodeError:
        raise ConfigurationError("file:…: the password is not UTF-8") from None


def _from_keyring(name: str) -> str:
    service, _, user = name.partition("/")
    try:
        import keyring
    except ImportError:
        raise ConfigurationError("keyring: the package keyring is not installed; pip install keyring") from None
    try:
        secret = keyring.get_password(service, user)
    except Exception as error:  # each of its back ends has its own errors
        raise DriverError(f"keyring:…: cannot be read: {type(error).__name__}") from None
    if secret is None:
        raise ConfigurationError("keyring:…: there is no such password; keyring set stores one")
    return secret


_KINDS = {"env": _from_environment, "file": _from_file, "keyring": _from_keyring}
