"""The MQTT client, with an end to what it takes; a module of its own, since the library is imported late."""

from __future__ import annotations

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

#: Of one packet [bytes]; a message of the node has a few hundred. MQTT allows 256 MiB, and the library takes them.
LONGEST_PACKET = 64 * 1024


class BrokerClient(Client):
    """Connects once; a packet that is too long ends the connection before its content is received."""

    def __init__(self) -> None:
        super().__init__(CallbackAPIVersion.VERSION2, reconnect_on_failure=False)

    def _sock_recv(self, bufsize: int) -> bytes:
        if bufsize > LONGEST_PACKET:
            raise ConnectionError(f"a packet of {bufsize} bytes")
        return super()._sock_recv(bufsize)
