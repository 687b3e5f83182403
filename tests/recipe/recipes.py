"""Recipes of the tests, and what loads them."""

import re
from pathlib import Path
from typing import Any

import pytest

from agent.core.errors import InputError
from agent.recipe import load_recipe

MINIMAL = """\
robot: comau_ns16
controller: {driver: tcp, address: 127.0.0.1:9100}
motion:
  via_points: {count: 6, box: {centre: [1.0 m, 0 m, 0.8 m], size: [0.1, 0.1, 0.1], orientation: [0, 180 deg, 0]}}
"""
FULL = """\
robot: comau_ns16
tool: {frame: [0 mm, 0 mm, 120 mm, 0 deg, 90 deg, 0 deg], mass: 2.1 kg, centre_of_mass: [0 mm, 0 mm, 60 mm]}
controller: {driver: tcp, address: 127.0.0.1:9100}
cell: {keep_out: [{name: table, box: {min: [0.4 m, -1 m, 0 m], max: [1.6 m, 1 m, 0.3 m]}}],
  joint_ranges: {joint_4: [-90 deg, 2]}}
motion:
  speed: 500 mm/s
  fly: {type: FLY_NORM, trajectory: FLY_FROM, distance: 30 mm, percent: 80 %, stress: 40 %}
  via_points:
    count: 6
    box:
      {centre: [1.0 m, 0 m, 0.8 m], size: [500 mm, 600 mm, 400 mm], orientation: [0 deg, 180 deg, 0 deg], cone: 30 deg}
search: {population: 20, generations: 10, seed: 7, method: random, interpolator: fly}
record: {rate: 250 Hz, cycles: 12}
estimate: {filter: {order: 4, cutoff: 20 Hz}, method: huber}
validate: {motions: 5, speed: 0.2 m/s, seed: 3}
gate: {normalised_rmse: 0.05}
recalibrate: {every: 12 h, parameters: all}
"""
POINTS = "points: [{pose: [1 m, 0, 0.8 m, 0, 180 deg, 0], range: [1 cm, 2 cm, 3 cm, 0, 10 deg, 0]}, \
{pose: [1, 0, 0.9, 0, 180 deg, 0], range: [0, 0, 0, 0, 0, 0]}]"
TUBE = "count: 4, tube: {path: [[1 m, 0, 0.8 m, 0, 180 deg, 0], [1 m, 0.2, 0.8 m, 0, 180 deg, 0]], radius: 50 mm}"


def with_via_points(text: str) -> str:
    return re.sub(r"via_points: .*", lambda _: f"via_points: {{{text}}}", MINIMAL)


def load_text(path: Path, text: str) -> Any:
    path.write_text(text, encoding="utf-8")
    return load_recipe(path)


def faults_of(path: Path, text: str) -> list[str]:
    with pytest.raises(InputError) as error:
        load_text(path, text)
    return str(error.value).splitlines()
