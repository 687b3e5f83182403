"""Recordings of simulators' users."""

import numpy as np
import pytest

from tests.recording.datasets.recordings import motion


@pytest.fixture
def chirp() -> dict[str, np.ndarray]:
    """The tensors of a PACE recording of three joints at 200 Hz."""
    position, command = motion(600, 3, 200.0)
    tensors = {"time": np.arange(600) / 200, "dof_pos": position, "des_dof_pos": command}
    return {name: values.astype(np.float32) for name, values in tensors.items()}
