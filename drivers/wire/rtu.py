"""Matches answers of Modbus RTU to requests: unlike in Modbus/TCP, answers do not name their request."""

from __future__ import annotations

from pymodbus.framer import FramerRTU

_READ, _WRITE = 3, 16
_WRITTEN = 8  # bytes of the answer to a write: unit, function, address, count, checksum


def without_strays(request: bytes, data: bytes) -> bytes:
    """What has come of the answer to a request, without whole answers before it that belong to earlier ones.

    An answer that comes late or twice would be taken for the next one. Whatever is no whole answer is left as it is.
    """
    while (size := _answer_size(data)) and size <= len(data) and not _belongs(request, data):
        frame, rest = data[:size], data[size:]
        if not FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big")):
            break
        data = rest
    return data


def _answer_size(data: bytes) -> int:
    """Bytes of the answer that begins here; 0 where none does that is known here."""
    if len(data) < 3:
        return 0
    return {_READ: 5 + data[2], _WRITE: _WRITTEN}.get(data[1], 0)


def _belongs(request: bytes, answer: bytes) -> bool:
    if request[:2] != answer[:2]:
        return False
    if request[1] == _READ:
        return answer[2] == 2 * int.from_bytes(request[4:6], "big")
    return request[2:6] == answer[2:6]
