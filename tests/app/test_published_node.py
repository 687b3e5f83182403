"""What a torque model loses where samples come from the C5G Open node as it is published."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import agent as ca
from fake_controller.build import build_controller
from fake_controller.servers.cnr.server import CnrServer
from tests.app.test_calibrate_cnr import recipe_for


def program(name: str, seed: int, moves: int) -> str:
    """Joint moves between random poses at full speed."""
    rng = np.random.default_rng(seed)
    poses = np.array([0, 0, -90, 0, 20, 0]) + rng.uniform(-1, 1, (moves, 6)) * [50, 20, 20, 50, 40, 60]
    lines = [f"  MOVE JOINT TO {{{', '.join(f'{value:.1f}' for value in pose)}}}" for pose in poses]
    return "\n".join([f"PROGRAM {name} HOLD, PROG_ARM=1", "BEGIN", *lines, f"END {name}", ""])


@pytest.fixture
def record(broker, write_recipe, run_agent, tmp_path: Path) -> Callable[..., Path]:
    """`record(name, seed, moves, period)` → the log of a program, by the ideal node, or one with a loop of a period."""

    def make(name: str, seed: int, moves: int, period: float | None) -> Path:
        folder = tmp_path / f"{name}_{period}"
        folder.mkdir()
        (folder / f"{name}.pdl").write_text(program(name, seed, moves), encoding="utf-8")
        controller = build_controller("comau_ns16", seed=7, clock="fast")
        at = {"broker": broker.address, "waits": True, "node_period": period}
        with closing(CnrServer(controller, watchdog=5.0, **at)) as server:
            log = folder / f"{name}.mcap"
            run = run_agent(
                "record", recipe_for(write_recipe, server.address), "--program", folder / f"{name}.pdl", "-o", log
            )
            assert run.returncode == 0, run.stderr
            assert ("times come from the set-points" in run.stderr) == bool(period)
        return log

    return make


@pytest.mark.verify
def test_an_uneven_node_loop_costs_little_model_accuracy(record, measured):
    """Over periods of 2.00 to 3 ms of the node's loop."""
    unseen = ca.read_logs(record("unseen", 2, 16, None), "comau_ns16")

    def error(period: float | None) -> float:
        logs = ca.read_logs([record(f"excite_{seed}", seed, 40, period) for seed in (1, 3)], "comau_ns16")
        result = ca.validate(ca.estimate("comau_ns16", logs), unseen).to_dict()
        return float(np.sqrt(np.mean(np.square(result["overall"]["normalised_rmse"]))))

    ideal = error(None)
    for period in (2.0e-3, 2.02e-3, 2.05e-3, 2.5e-3, 3.0e-3):  # next to 2 ms stamps and snapshots beat in the band
        ratio = error(period) / ideal
        measured(f"cnr_comau, published node, loop of {1e3 * period:.2f} ms: error over the ideal node's", ratio, "")
        assert ratio < 1.2
