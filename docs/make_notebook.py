"""Writes docs/notebook.ipynb: its cells, executed here one after the other, with what they show.

`python docs/make_notebook.py` writes it, without a notebook server; a test executes the cells again.
"""

from __future__ import annotations

import ast
import json
import os
import tempfile
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).with_name("notebook.ipynb")

_INTRODUCTION = """\
# A calibration and a diagnosis, from logs

The logs are simulated here, so that the notebook needs no robot and no data: rigid-body dynamics of the COMAU NS16,
friction of an own form, noise. On Friday the friction of joint 3 has risen by 60 %."""

_SIMULATE = """\
from pathlib import Path

import numpy as np

from agent.recording import Log, write_log
from agent.robot import load_robot
from agent.robot.dynamics import Dynamics

arm = load_robot("comau_ns16")
dynamics, t = Dynamics(arm), np.arange(0, 5, 0.002)


def simulate(name, seed, friction_of_joint_3=1.0):
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(1.5, 5.0, arm.dof), rng.uniform(0, 6, arm.dof)
    angle = rate * t[:, None] + phase
    q = 0.25 * np.sin(angle) + [0, 0.2, -1.2, 0, 0.8, 0]
    qd, qdd = 0.25 * rate * np.cos(angle), -0.25 * rate**2 * np.sin(angle)
    level = 0.05 * arm.nominal_torque * [1, 1, friction_of_joint_3, 1, 1, 1]
    torque = dynamics.inverse_dynamics(q, qd, qdd) + level * (np.tanh(qd / 0.01) + qd)
    torque += 0.002 * arm.nominal_torque * rng.normal(size=q.shape)
    log = Log(Path(name), arm.joint_names, t, q, None, torque, None, None, 500.0, 0.0, ((0, len(t)),))
    write_log(Path("logs") / name, log)


Path("logs").mkdir(exist_ok=True)
for k in (1, 2, 3):
    simulate(f"monday_{k}.mcap", k)
for k in (4, 5):
    simulate(f"friday_{k}.mcap", k, friction_of_joint_3=1.6)"""

#: Markdown cells begin with "#"; all others are code.
CELLS = (
    _INTRODUCTION,
    _SIMULATE,
    "# Read and estimate",
    'import agent as ca\n\nlogs = ca.read_logs("logs/monday_*.mcap", "comau_ns16")\nlogs',
    'model = ca.estimate("comau_ns16", logs[:2], method="weighted")\nmodel',
    "# Predict a motion that took no part in the fit",
    "ca.validate(model, logs[2])",
    "# On Friday model and robot disagree: why?",
    'found = ca.diagnose("comau_ns16", "logs/friday_*.mcap", model)\nfound',
    "# Keep it",
    'model.save("model.json")\nca.report(found, "diagnosis.html")',
)


def is_text(cell: str) -> bool:
    """Whether a cell is Markdown."""
    return cell.startswith("# ")


def execute(source: str, names: dict[str, Any]) -> dict[str, str]:
    """Run a cell; what its last expression shows, by MIME type."""
    tree = ast.parse(source)
    last = tree.body.pop().value if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "<cell>", "exec"), names)
    value = None if last is None else eval(compile(ast.Expression(last), "<cell>", "eval"), names)
    if value is None:
        return {}
    html = getattr(value, "_repr_html_", None)
    return {"text/plain": repr(value), **({} if html is None else {"text/html": html()})}


def notebook() -> dict[str, Any]:
    """The document (nbformat 4.5), executed in a folder of its own."""
    cells, names, before = [], {}, Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for k, source in enumerate(CELLS):
                cells.append(_cell(f"cell-{k}", source, {} if is_text(source) else execute(source, names), k))
        finally:
            os.chdir(before)
    return {
        "cells": cells,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def _cell(name: str, source: str, shown: dict[str, str], count: int) -> dict[str, Any]:
    common = {"id": name, "metadata": {}, "source": source.splitlines(keepends=True)}
    if is_text(source):
        return {"cell_type": "markdown", **common}
    data = {kind: text.splitlines(keepends=True) for kind, text in shown.items()}
    result = {"output_type": "execute_result", "execution_count": count, "data": data, "metadata": {}}
    return {"cell_type": "code", **common, "execution_count": count, "outputs": [result] if shown else []}


if __name__ == "__main__":
    NOTEBOOK.write_text(json.dumps(notebook(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
