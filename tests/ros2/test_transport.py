"""What an agent on ROS 2 leaves behind when it is killed."""

import subprocess
import sys

from tests.ros2.conftest import DOMAIN

AGENT = """
import os, sys
from drivers.transports.ros2.ros import Ros
ros = Ros(int(sys.argv[1]), "agent")
print(*(line for line in open("/proc/self/maps") if "/dev/shm/fast" in line))
sys.stdout.flush()
os._exit(0)
"""


def test_holds_no_shared_memory():
    """Nor any lock in it, on which others would wait."""
    command = [sys.executable, "-c", AGENT, str(DOMAIN)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert ended.stdout.strip() == ""
