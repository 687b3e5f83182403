"""The same TX40 recording through figaroh 1.0.2 and through this agent, side by side.

    python benchmarks/against_figaroh.py PYTHON      (of an environment with pip install figaroh==1.0.2)

Both get the same joint positions and torques, 5 kHz, 0.1 s to 4.54 s, and predict 4.54 s to 7.5 s, which neither saw.
Measured torque and both predictions then go through one filter (20 Hz, zero phase), no sample is dropped. figaroh runs
by its own classes; the columns of the coupled wrist motor are added to its regressor, and torque is filtered like
positions: both it leaves to the user.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "../shared/data/tx40"
EXAMPLE = ROOT / "recipes/examples/tx40"
CUTOFF = 20.0
#: figaroh's settings: low-pass of positions and torque [Hz], decimation of regressor and torque. First its defaults,
#: then the best of those tried (20 to 100 Hz, every 1st to 100th) on the held-out segment itself, which flatters it.
SETTINGS = {"defaults (100 Hz, every 10th)": (100.0, 10), "best tried (100 Hz, every 50th)": (100.0, 50)}


def main() -> int:
    """0, also where figaroh fails: that is said."""
    parser = argparse.ArgumentParser()
    parser.add_argument("python", type=Path, help="of an environment with figaroh")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        figaroh_side(arguments.worker)
        return 0
    if not DATA.is_dir():
        print("skipped: ../shared/data/tx40 beside the checkout is missing")
        return 0
    sys.path.insert(0, str(ROOT))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = export_data(folder)
        run_worker(arguments.python, folder)
        table(held_out_errors(logs, folder))
    return 0


def run_worker(python: Path, folder: Path) -> None:
    """Have figaroh write its predictions; where it fails that is said."""
    run = subprocess.run(
        [str(python), str(Path(__file__).resolve()), str(python), "--worker", str(folder)],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode:
        print(f"figaroh skipped: {run.stderr.strip().splitlines()[-1]}")


def export_data(folder: Path) -> dict:
    """Logs of both segments, and the same numbers for figaroh."""
    from agent.recording import import_log, read_log
    from agent.robot import load_robot

    robot = load_robot(EXAMPLE / "robot.yaml")
    logs = {}
    for name in ("fit", "held_out"):
        path = folder / f"{name}.mcap"
        import_log(robot, EXAMPLE / f"map_{name}.yaml", [DATA / "pos_read_data.csv", DATA / "curr_data.csv"], path)
        logs[name] = read_log(path, robot)
        np.savez(folder / f"{name}.npz", t=logs[name].t, q=logs[name].position, torque=logs[name].effort)
    (folder / "robot.urdf").write_text(robot.urdf, encoding="utf-8")
    return {"robot": robot, **logs}


def held_out_errors(logs: dict, folder: Path) -> list[tuple]:
    """Label, held-out errors by the same filter, and seconds of the fit, of the agent and of what figaroh predicted."""
    from agent.core import one_blas_thread
    from agent.estimation import EstimationSettings, FilterSettings, estimate
    from agent.estimation.signals.filtering import motions
    from agent.validation import validate

    rows = []
    with one_blas_thread():
        for method in ("weighted", None):
            start = time.process_time()
            model = estimate(logs["robot"], [logs["fit"]], EstimationSettings.create(CUTOFF, method))
            seconds = time.process_time() - start
            result = validate(model, [logs["held_out"]]).overall
            label = f"agent, {method}" if method else f"agent, defaults (chose {model.method})"
            rows.append((label, result.relative_error_all_joints, result.relative_error, seconds))
        for path in sorted(folder.glob("predicted_*.npz")):
            (motion,) = motions(logs["held_out"], FilterSettings(CUTOFF), reduce=False)
            found = np.load(path)
            measured = motion.low_pass(motion.torque)
            error = measured - motion.low_pass(found["torque"])
            relative = np.linalg.norm(error, axis=0) / np.linalg.norm(measured, axis=0)
            total = float(np.linalg.norm(error) / np.linalg.norm(measured))
            rows.append((f"figaroh, {found['label']}", total, relative, float(found["seconds"])))
    return rows


def table(rows: list[tuple]) -> None:
    """Print all."""
    print(f"TX40, held-out segment, {CUTOFF:g} Hz, relative torque error [%]; CPU time of the fit, one thread")
    print(f"{'':42} {'all':>6}  {'per joint':36} {'fit':>8}")
    for label, total, joints, seconds in rows:
        cells = " ".join(f"{100 * value:5.1f}" for value in joints)
        print(f"{label:42} {100 * total:6.2f}  {cells:36} {seconds:6.2f} s")


def figaroh_side(folder: Path) -> None:
    """In figaroh's environment: fit and predict."""
    import logging

    from figaroh.identification.base_identification import BaseIdentification
    from figaroh.tools.qrdecomposition import build_baseRegressor
    from figaroh.tools.regressor import build_regressor_reduced
    from figaroh.tools.robot import Robot

    logging.disable(logging.CRITICAL)
    robot = Robot(str(folder / "robot.urdf"), str(folder))
    joints = list(robot.model.names)[1:]
    flags = ("has_friction", "has_actuator_inertia", "has_joint_offset", "is_joint_torques")

    class Tx40(BaseIdentification):
        """One segment; `load_param` takes a ready dictionary instead of a file."""

        segment = "fit"

        def load_param(self, config_file: dict, setting_type: str = "identification") -> None:
            self.identif_config = config_file

        def load_trajectory_data(self, data_source: str | None = None) -> dict:
            data = np.load(folder / f"{self.segment}.npz")
            return {
                "timestamps": data["t"],
                "positions": data["q"],
                "velocities": None,
                "accelerations": None,
                "torques": data["torque"],
            }

        def process_torque_data(self, **options: object) -> np.ndarray:
            return self._apply_filters(self.raw_data["torques"], **self.filter_config["filter_params"])

        def calculate_full_regressor(self) -> None:
            super().calculate_full_regressor()
            speed, acceleration = (self.processed_data[name] for name in ("velocities", "accelerations"))
            axle, turning = speed[:, 4] + speed[:, 5], acceleration[:, 4] + acceleration[:, 5]
            extra = np.zeros((len(self.dynamic_regressor), 3))
            extra[4 * len(axle) :] = np.tile(np.stack([axle, np.sign(axle), turning], axis=1), (2, 1))
            self.dynamic_regressor = np.column_stack([self.dynamic_regressor, extra])

        def initialize_standard_parameters(self) -> None:
            super().initialize_standard_parameters()
            self.standard_parameter.update({"fvm6": 0.0, "fsm6": 0.0, "Iam6": 0.0})

        def _compute_validation_metrics(self) -> None:
            """An in-sample report that does not know the added columns, and would count as time of the fit."""

    class HeldOut(Tx40):
        segment = "held_out"

    def settings_of(cutoff: float) -> dict:
        filters = {"nbutter": 4, "f_butter": cutoff, "med_fil": 5, "f_sample": 5000.0}
        return {
            **dict.fromkeys(flags, True),
            "active_joints": joints,
            "act_idxq": list(range(6)),
            "act_idxv": list(range(6)),
            "filter_config": {"differentiation_method": "gradient", "filter_params": filters},
        }

    for number, (label, (cutoff, every)) in enumerate(SETTINGS.items()):
        start = time.process_time()
        fit = Tx40(robot, settings_of(cutoff))
        fit.initialize()
        fit.solve(decimate=every > 1, decimation_factor=every, plotting=False, wls=True)
        seconds = time.process_time() - start
        other = HeldOut(robot, settings_of(cutoff))
        other.initialize()
        reduced = build_regressor_reduced(other.dynamic_regressor, fit._idx_eliminated)
        torque = build_baseRegressor(reduced, fit._base_indices) @ fit.phi_base
        torque = torque.reshape(6, -1).T
        np.savez(folder / f"predicted_{number}.npz", torque=torque, label=label, seconds=seconds)


if __name__ == "__main__":
    sys.exit(main())
