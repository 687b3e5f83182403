"""What each number of diagnosis, experiment and effects changes: `python -m benchmarks.sensitivity` writes the table.

A number is a constant in `agent/diagnosis`, `agent/experiment` and `agent/model/effects`; a grid is one number. 0 and
-1 are none, nor are 1, 2 and ½ in formulas. Left out are guards of divisions (at most 1e-6 or at least 1e6), numbers in
texts, exponents, factors of 100 and 1000, and counts that subscripts and shapes need. Each is halved and doubled while
up to three small runs of a fixed set are diagnosed that come to it: machines of the emulator and of the second world
with two joints, other ways to record, and logs of real arms. Some have six joints and plan a further motion. Of a share
above one half the complement is varied, of a factor between 1 and 1.5 what exceeds 1.

There are four kinds:

- A derived number follows from a formula or a definition. Its comment, or its source, begins with "derived:".
- A numerical one says how exactly or how fast something is computed that has a value without it: a batch, a step, an
  iteration limit, the points of a grid whose best is refined. It has a name next to the algorithm and a comment that
  begins with "numerical:". That is a claim, so it counts as such only once halving and doubling it changes nothing in
  runs that reach it; a test fails if it changes anything.
- A number of figures belongs to a package that no deciding module imports, such as the run forward of a corrected
  simulator, or to a module whose results are only shown. A test holds the imports, and replaces those results.
- All others decide.

Results are kept in `docs/measured/numbers.csv`, so that an interrupted run goes on where it stopped:

    python -m benchmarks.sensitivity             # give every number a line, write docs/measured/numbers.md
    python -m benchmarks.sensitivity --runs 12   # and measure what fewer than 12 runs have seen
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import csv
import importlib
import pickle
import re
import sys
import tempfile
import time
import types
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared/data"
PACKAGES = ("agent/diagnosis", "agent/experiment", "agent/model/effects")
TABLE, PAGE = ROOT / "docs/measured/numbers.csv", ROOT / "docs/measured/numbers.md"
RUNS = ROOT / "build/numbers/runs.pkl"
#: A package that no deciding module imports, and a module whose results are only shown: their numbers are of figures.
FIGURES = ("agent/diagnosis/forward", "agent/diagnosis/gap/regime_shares.py")
COLUMNS = ("number", "value", "runs", "executed", "half_answers", "half_probabilities", "double_answers",
           "double_probabilities")  # fmt: skip
_MOVED = 0.05  # of a probability that counts as changed
ENOUGH = 3  # runs that reach a number, in which it is varied
_CYCLE, _RATE = 3.0, 250.0  # s and Hz of the emulator's motions


@dataclass(frozen=True)
class Site:
    """One number: `kind` is module, class or inline; `owner` the class or function that it stands in."""

    path: str
    kind: str
    owner: str
    name: str
    value: Any
    line: int
    comment: str
    nodes: tuple[tuple[int, int], ...]

    @property
    def key(self) -> str:
        """Its name in the table; lines may move without changing it."""
        place = self.path.removeprefix("agent/").removesuffix(".py")
        return f"{place}: {'.'.join(part for part in (self.owner, self.name) if part)}"

    @property
    def claims(self) -> str:
        """What it says to be: derived, numerical, or nothing of these."""
        return next((kind for kind in ("derived", "numerical") if f"{kind}:" in self.comment), "")

    @property
    def module(self) -> str:
        """Dotted name of its module."""
        return self.path.removesuffix(".py").replace("/", ".")

    @property
    def symbol(self) -> str | None:
        """What reads it, if it has a name."""
        return None if self.kind == "inline" else self.name


def sites() -> list[Site]:
    """All numbers in the order of the files."""
    return [
        site for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")) for site in _Numbers(path).found
    ]


def _counts(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) not in (0, 1, 2) and 1e-6 < abs(value) < 1e6


class _Numbers(ast.NodeVisitor):
    """Numbers of one module."""

    def __init__(self, path: Path):
        self.path = path.relative_to(ROOT).as_posix()
        text = path.read_text("utf-8")
        self._lines = text.splitlines()
        self._owners: list[tuple[str, str]] = []
        self._seen: dict[tuple[str, str], int] = {}
        self.found: list[Site] = []
        tree = ast.parse(text)
        self._texts = {
            node.targets[0].id: node.value.value
            for node in tree.body
            if isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.targets[0], ast.Name)
        }
        self.visit(tree)

    @property
    def _owner(self) -> str:
        return ".".join(name for _, name in self._owners)

    def _in_function(self) -> bool:
        return any(kind == "function" for kind, _ in self._owners)

    def _comment(self, node: ast.expr | ast.stmt) -> str:
        line = self._lines[node.lineno - 1]
        if "  # " in line:
            return line.split("  # ", 1)[1]
        above = node.lineno - 2
        said: list[str] = []
        while above >= 0 and re.match(r"\s*#:? ", self._lines[above]):
            said.insert(0, re.sub(r"^\s*#:? ", "", self._lines[above]))
            above -= 1
        return " ".join(said)

    def _enter(self, node: Any, kind: str) -> None:
        self._owners.append((kind, node.name))
        self.generic_visit(node)
        self._owners.pop()

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._enter(node, "class")

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._enter(node, "function")

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Numbers in texts."""

    def visit_Subscript(self, node: ast.Subscript) -> None:
        """An index is none, but a condition may decide which rows count."""
        self.visit(node.value)
        for condition in (n for n in ast.walk(node.slice) if isinstance(n, ast.Compare)):
            self.visit(condition)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Exponents are part of a formula; a factor of 100 or 1000 is a unit."""
        for side in (node.left, node.right):
            value = getattr(side, "value", None)
            exponent = isinstance(node.op, ast.Pow) and side is node.right and isinstance(side, ast.Constant)
            scaled = isinstance(node.op, (ast.Mult, ast.Div)) and value in (100, 1000)
            if not (exponent or scaled):
                self.visit(side)

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if called in ("reshape", "range", "zeros", "eye", "tile", "split", "round"):
            for keyword in node.keywords:
                self.visit(keyword.value)
            self.visit(node.func)
            for argument in node.args:
                if not isinstance(argument, (ast.Constant, ast.Tuple, ast.UnaryOp)):
                    self.visit(argument)
            return
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        (target, *_) = node.targets
        if self._in_function():
            self.generic_visit(node)
        elif isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            for name, value in zip(target.elts, node.value.elts, strict=True):
                self._named(name, value, node)
        else:
            self._named(target, node.value, node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if self._in_function() or node.value is None:
            self.generic_visit(node)
        else:
            self._named(node.target, node.value, node)

    def _named(self, target: ast.expr, value: ast.expr, node: ast.stmt) -> None:
        comment = ""
        if isinstance(value, ast.Call) and getattr(value.func, "id", "") == "number":
            value, *about = value.args
            said = [self._texts.get(a.id, "") if isinstance(a, ast.Name) else ast.literal_eval(a) for a in about]
            comment = "; ".join(map(str, said))
        nodes = _of_name(value)
        if not nodes or not isinstance(target, ast.Name):
            return
        if isinstance(value, ast.Dict) and not all(isinstance(v, ast.Constant) for v in value.values):
            return
        comment = comment or self._comment(node)
        kind = "class" if self._owners else "module"
        at = tuple(map(_at, nodes))
        self.found.append(Site(self.path, kind, self._owner, target.id, ast.unparse(value), node.lineno, comment, at))

    def visit_Tuple(self, node: ast.Tuple) -> None:
        inside = _constants(node)
        if inside and all(isinstance(e, (ast.Constant, ast.UnaryOp)) for e in node.elts):
            self._inline(node, inside)
        else:
            self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if _counts(node.value) and node.value != 0.5:
            self._inline(node, [node])

    def _inline(self, node: ast.expr, nodes: Sequence[ast.Constant]) -> None:
        if not self._in_function():
            return
        text = ast.unparse(node)
        number = self._seen[self._owner, text] = self._seen.get((self._owner, text), 0) + 1
        name = text if number == 1 else f"{text} ({number})"
        self.found.append(
            Site(self.path, "inline", self._owner, name, text, node.lineno, self._comment(node), tuple(map(_at, nodes)))
        )


def _of_name(value: ast.expr) -> list[ast.Constant]:
    """Numbers of a constant with a name: 1 and 2 count where they are all of it."""
    whole = isinstance(value, ast.Constant) and type(value.value) in (int, float) and value.value in (1, 2)
    return [value] if whole else _constants(value)


def _constants(node: ast.AST) -> list[ast.Constant]:
    """Numbers below a node that count, those of subscripts left out."""
    if isinstance(node, ast.Constant):
        return [node] if _counts(node.value) else []
    parts = [node.value] if isinstance(node, ast.Subscript) else ast.iter_child_nodes(node)
    return [constant for part in parts for constant in _constants(part)]


def _at(node: ast.Constant) -> tuple[int, int]:
    return node.lineno, node.col_offset


def varied(value: Any, factor: float) -> Any:
    """A number halved or doubled: of a share above one half the complement, of a factor up to 1.5 what exceeds 1."""
    if isinstance(value, (tuple, list)):
        return type(value)(varied(each, factor) for each in value)
    if isinstance(value, np.ndarray):
        return np.array([varied(each, factor) for each in value.tolist()])
    if isinstance(value, dict):
        return {key: varied(each, factor) for key, each in value.items()}
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    if isinstance(value, int):
        return max(1, round(value * factor))
    if 0.5 < value < 1:
        return 1 - min((1 - value) * factor, 1.0)
    if 1 < value <= 1.5:
        return 1 + (value - 1) * factor
    return value * factor


class _Varied(ast.NodeTransformer):
    def __init__(self, nodes: Sequence[tuple[int, int]], factor: float):
        self._nodes, self._factor = set(nodes), factor

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        if _at(node) in self._nodes:
            return ast.copy_location(ast.Constant(varied(node.value, self._factor)), node)
        return node


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    for each in code.co_consts:
        if isinstance(each, types.CodeType):
            yield each
            yield from _codes(each)


def _functions(module: Any) -> Iterator[types.FunctionType]:
    """Functions and methods that a module defines, also behind properties and caches."""
    owners = [module, *(v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__)]
    for owner in owners:
        for entry in list(vars(owner).values()):
            for way in ("fget", "func", "__wrapped__", "__func__"):
                entry = getattr(entry, way, entry)
            if isinstance(entry, types.FunctionType) and entry.__module__ == module.__name__:
                yield entry


@contextlib.contextmanager
def changed(site: Site, factor: float) -> Iterator[None]:
    """The program with one number halved or doubled."""
    module = importlib.import_module(site.module)
    with contextlib.ExitStack() as undo:
        if site.kind == "inline":
            tree = _Varied(site.nodes, factor).visit(ast.parse((ROOT / site.path).read_text("utf-8")))
            new = {
                (code.co_qualname, code.co_firstlineno): code for code in _codes(compile(tree, module.__file__, "exec"))
            }
            for function in _functions(module):
                code = new.get((function.__code__.co_qualname, function.__code__.co_firstlineno))
                if code is not None and code.co_consts != function.__code__.co_consts:
                    undo.callback(setattr, function, "__code__", function.__code__)
                    function.__code__ = code
        elif site.kind == "class":
            kind = module
            for part in site.owner.split("."):
                kind = getattr(kind, part)
            old = kind.__dict__.get(site.name, None)
            for each in [kind, *_singletons(kind)]:
                before = getattr(each, site.name, old)
                if isinstance(each, type):
                    if isinstance(before, types.MemberDescriptorType):
                        continue
                    undo.enter_context(mock.patch.object(each, site.name, varied(before, factor)))
                else:
                    object.__setattr__(each, site.name, varied(before, factor))
                    undo.callback(object.__setattr__, each, site.name, before)
        else:
            old_value = getattr(module, site.name)
            new_value = varied(old_value, factor)
            for other in _holding(site):
                undo.enter_context(mock.patch.object(other, site.name, new_value))
                for function, now in _defaults(other, old_value, new_value):
                    undo.enter_context(mock.patch.object(function, "__defaults__", now))
                for owner, follower, now in list(_followers(other, site.name)):
                    undo.enter_context(mock.patch.object(owner, follower, now))
        undo.callback(_forget, module)
        _forget(module)
        yield


def _defaults(module: Any, old: Any, new: Any) -> Iterator[tuple[types.FunctionType, tuple[Any, ...]]]:
    """Functions with a constant as the default of an argument, and their defaults with another in its stead."""
    for function in _functions(module):
        usual = function.__defaults__ or ()
        if any(value is old for value in usual):
            yield function, tuple(new if value is old else value for value in usual)


def _holding(site: Site) -> list[Any]:
    """The module of a constant, and those that import it by its name."""
    value = getattr(importlib.import_module(site.module), site.name)
    modules = [module for name, module in sys.modules.items() if name.startswith("agent.")]
    return [module for module in modules if vars(module).get(site.name) is value]


def _followers(module: Any, name: str) -> Iterator[tuple[Any, str, Any]]:
    """What a module and its classes work out of a constant when they are loaded: owner, name and value as of now."""
    changed_names, scope = {name}, dict(vars(module))

    def again(body: Sequence[ast.stmt], owner: Any, local: dict[str, Any]) -> Iterator[tuple[Any, str, Any]]:
        for node in body:
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            if isinstance(target, ast.Name) and target.id != name and (value := getattr(node, "value", None)):
                if changed_names & {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}:
                    local[target.id] = eval(compile(ast.Expression(value), module.__file__, "eval"), scope | local)
                    changed_names.add(target.id)
                    yield owner, target.id, local[target.id]
            elif isinstance(node, ast.ClassDef):
                yield from again(node.body, scope[node.name], dict(vars(scope[node.name])))

    yield from again(ast.parse(Path(module.__file__).read_text("utf-8")).body, module, scope)


def _forget(module: Any) -> None:
    """Empty the caches of functions, which would answer with the number as it was."""
    for entry in vars(module).values():
        if hasattr(entry, "cache_clear"):
            entry.cache_clear()


def _singletons(kind: type) -> list[Any]:
    """Frozen objects of a class that modules hold, such as LAW and LIMITS."""
    held = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("agent."):
            held |= {id(v): v for v in vars(module).values() if type(v) is kind}
    return list(held.values())


# --------------------------------------------------------------------------------------------------------------- runs


@dataclass(frozen=True)
class Run:
    """Logs to be judged by the model of healthy logs.

    With a `problem`, a further motion is planned too; of a `baseline`, what the healthy arm has of effects is learnt.
    """

    name: str
    robot: Any
    model: Any
    logs: tuple[Any, ...]
    drives_off: Any = None
    file: str = ""
    problem: Any = None
    baseline: tuple[Any, ...] = ()


def make_runs(count: int) -> list[Run]:
    """The first of the fixed set, and those that plan a further motion.

    Some have one effect or another way to record, the others are drawn.
    """
    groups = (_chosen(), _others(), _mixed([_emulated(), _second_world(), _real()]))
    return [*islice(_mixed(groups), count), *_experiments()]


def _mixed(groups: Iterable[Iterator[Run]]) -> Iterator[Run]:
    """One of each in turn, while there are some."""
    waiting = list(groups)
    while waiting:
        for group in list(waiting):
            try:
                yield next(group)
            except StopIteration:
                waiting.remove(group)


#: Effects of the emulator that have numbers of their own.
_EFFECTS = (
    "contact",
    "backlash",
    "joint_elasticity",
    "torque_ripple",
    "time_delay",
    "dress_pack",
    "payload",
    "thermal",
)
_PUSH = {"effect": "contact", "parameters": {"force": (20.0, -40.0, 60.0), "start": 2.0, "duration": 0.8}}


def _chosen() -> Iterator[Run]:
    """Two-joint arms of the emulator with one effect each."""
    from fake_controller.actuation import EFFECTS
    from fake_controller.withheld.cases import Mix, draw_cases

    for name in (name for stem in _EFFECTS for name in EFFECTS if name.startswith(stem)):
        robot, model = _healthy(7)
        mix = Mix({"none": 0.0, "one": 1.0, "two": 0.0, "outside": 0.0}, (1.0, 2.0), (name,))
        effects = [_PUSH] if name == "contact" else next(iter(draw_cases(1, 21, robot, mix))).effects
        yield Run(f"emulator {name}", robot, model, _logs(robot, 7, 70, effects))


def _others() -> Iterator[Run]:
    """Other ways to record: positions alone, a simulator's file, another rate, the drives off, torque that is held."""
    from tests.diagnosis.test_position_logs import ARM, recorded

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(ARM, encoding="utf-8")
        positions = tuple(recorded(path, phase, late=0.06, friction=3.0) for phase in (1, 2))
    yield Run("position_logs", None, None, positions, file=ARM)
    robot, model = _healthy(8)
    logs = _logs(robot, 8, 80, ())
    yield Run("simulator_file", robot, None, logs, file=robot.urdf)
    faster = [replace(log, planned_position=_resampled(log.planned_position, log.t, 1.01 * log.t)) for log in logs]
    yield Run("motion_gap", robot, model, tuple(faster))
    shift = 6.0 * (np.arange(robot.dof) == 1)
    still = replace(
        logs[0], position=0 * logs[0].position + logs[0].position[:1], velocity=0 * logs[0].velocity,
        effort=shift + 0.05 * np.random.default_rng(2).normal(size=logs[0].position.shape), reference_position=None,
    )  # fmt: skip
    offset = tuple(replace(log, effort=log.effort + shift) for log in logs)
    yield Run("drives_off", robot, model, offset, drives_off=still)
    held = [replace(log, effort=np.clip(log.effort, None, np.quantile(log.effort, 0.8, axis=0))) for log in logs]
    yield Run("held_torque", robot, model, tuple(held))
    yield _read_behind()
    baseline = _logs(robot, 8, 8, ())
    yield Run("healthy", robot, model, logs, baseline=baseline)


def _read_behind() -> Run:
    """Positions of a hobby arm with play in a gear, whose servo reads the link behind it."""
    from agent.recording import read_recording
    from agent.simulators import load_arm
    from fake_controller.servoed.__main__ import write

    play = {"effect": "backlash", "joints": ["joint_5"], "parameters": {"gap": 0.0183}}
    frames = {"rate": 200.0, "jitter": 0.0002, "clipped": False, "format": "csv"}
    truth = {"machine": 2914479001988846812, "motion": 1044981598051068187, "motions": "both"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write({"truth": truth | {"effects": [play], "frames": frames}, "folder": name, "seconds": 16.0})
        arm = load_arm(folder / "arm.xml")
        read = (read_recording(path, arm)[0] for path in sorted((folder / "logs").glob("*.csv")))
        logs = tuple(_in_memory(log) for recorded in read for log in recorded)
        return Run("read behind backlash", None, None, logs, file=(folder / "arm.xml").read_text("utf-8"))


#: Effects that slow motions leave open.
_OPEN = ("gravity_spring", "torque_offset", "dress_pack", "friction_change")


def _experiments() -> Iterator[Run]:
    """Six-joint arms whose slow motions leave something open, and where a further one may lie."""
    from agent.excitation import LoopProblem
    from agent.motion import FlyTrajectory, FlyType, Pdl2Settings, ViaRegions
    from agent.motion.regions import BoxRegion
    from agent.robot import kinematics_for
    from fake_controller.plant import Plant
    from fake_controller.withheld.cases import Mix, draw_cases
    from tests.small_arms import learn, make_arm, record

    robot = make_arm("RRRRRR")
    model = learn(robot)
    pose = kinematics_for(robot, None).forward(np.array([[0.2, 0.2, 1.2, 0.3, 0.8, 0.2]]))[0]
    fly = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02)
    regions = ViaRegions((BoxRegion(pose, np.full(3, 0.25), 0.6),) * 4)
    problem = LoopProblem(robot=robot, regions=regions, settings=fly.changed(linear_speed=0.5))
    mix = Mix({"none": 0.0, "one": 1.0, "two": 0.0, "outside": 0.0}, (0.4, 1.0), _OPEN)
    drawn = [case.effects for case in draw_cases(12, 5, robot, mix)]
    for effects in (*drawn[-3:], drawn[5], []):  # a motion settles three kinds, and not one
        plant = Plant(robot, seed=3, effects=effects)
        logs = tuple(record(plant, log, seed, 0.3) for log, seed in (("one", 21), ("two", 22)))
        name = "+".join(e["effect"] for e in effects) or "healthy"
        yield Run(f"{name} experiment", robot, model, logs, problem=problem)


def _resampled(values: np.ndarray, time: np.ndarray, when: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(when, time, column) for column in values.T], axis=1)


def _healthy(machine: int) -> tuple[Any, Any]:
    """The emulator's two-joint arm and the model of its healthy logs."""
    from agent.estimation import estimate
    from agent.robot import Joint, RobotDescription

    robot = _two_joints(Joint, RobotDescription)
    return robot, estimate(robot, list(_logs(robot, machine, machine, ())))


def _logs(robot: Any, machine: int, motion: int, effects: Any) -> tuple[Any, ...]:
    from fake_controller.plant import Plant

    plant = Plant(robot, seed=machine, effects=effects, period=1 / _RATE)
    return tuple(_recorded(plant, f"l{motion + k}", motion + k) for k in range(2))


def _emulated() -> Iterator[Run]:
    """Two-joint arms of the emulator: every effect of the vocabulary, effects outside it, pairs, and healthy ones."""
    from agent.estimation import estimate
    from agent.robot import Joint, RobotDescription
    from fake_controller.actuation import EFFECTS
    from fake_controller.plant import Plant
    from fake_controller.withheld.cases import Mix, draw_cases

    robot = _two_joints(Joint, RobotDescription)
    mix = Mix({"none": 0.15, "one": 0.65, "two": 0.1, "outside": 0.1}, (0.3, 2.0), tuple(EFFECTS))
    for case in draw_cases(40, 20, robot, mix):
        try:
            healthy = Plant(robot, seed=case.machine % 2**31, period=1 / _RATE)
            baseline = [_recorded(healthy, f"b{k}", case.machine + k) for k in range(2)]
            machine = Plant(robot, seed=case.machine % 2**31, effects=case.effects, period=1 / _RATE)
            logs = [_recorded(machine, f"l{k}", case.motion + k) for k in range(2)]
            model = estimate(robot, baseline)
        except Exception as error:  # an effect that does not fit two joints
            print(f"left out: {[e['effect'] for e in case.effects]}: {error}", file=sys.stderr)
            continue
        name = "+".join(e["effect"] for e in case.effects) or "healthy"
        yield Run(f"emulator {case.number} {name}", robot, model, tuple(logs))


def _two_joints(joint: Any, description: Any) -> Any:
    parts, parent = ['<robot name="two"><link name="base"/>'], "base"
    for k, (mass, axis) in enumerate(((22.0, "0 0 1"), (12.0, "0 1 0")), start=1):
        bar = mass * 0.3**2 / 12
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="0.15 0 0.03"/><mass value="{mass}"/>'
            f'<inertia ixx="{0.1 * bar}" iyy="{bar}" izz="{bar}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint_{k}" type="revolute"><parent link="{parent}"/><child link="link_{k}"/>'
            f'<origin xyz="{0.3 * (k > 1)} 0 0"/><axis xyz="{axis}"/>'
            '<limit lower="-2" upper="2" velocity="3" effort="900"/></joint>'
        )
        parent = f"link_{k}"
    joints = tuple(
        joint(f"joint_{k}", False, gear, 1.0, 2.5, 8.0, None, 2e-4, None, None, -2.0, 2.0)
        for k, gear in ((1, 100.0), (2, -80.0))
    )
    return description(
        "two", "".join([*parts, "</robot>"]), parent, (0.0, 0.0, -9.80665), None, joints, ((1.0, 0.0), (0.0, 1.0))
    )


def _recorded(plant: Any, name: str, seed: int) -> Any:
    from agent.recording import Log

    rng, n = np.random.default_rng(seed), plant.robot.dof
    at = np.arange(round(_CYCLE * _RATE)) / _RATE
    a, b = rng.normal(size=(2, 4, n)) * 0.35 / np.arange(1, 5)[:, None]
    phase = 2 * np.pi * np.arange(1, 5) * at[:, None] / _CYCLE
    fade = np.sin(0.5 * np.pi * np.clip(np.minimum(at, at[-1] - at) / 0.6, 0, 1))[:, None] ** 2
    planned = np.tile(fade * (np.sin(phase) @ a + np.cos(phase) @ b), (2, 1))
    planned *= 0.3 if seed % 3 == 0 else 1.0
    q, qd = plant.executed_path(planned, np.gradient(planned, 1 / _RATE, axis=0))
    plant.rest(q[0])
    chunks = list(plant.run(q, qd))
    position, velocity, torque = (
        np.concatenate([getattr(c, part) for c in chunks]) for part in ("position", "velocity", "torque")
    )
    plan = planned[np.minimum(np.arange(len(q)), len(planned) - 1)]
    return Log(
        path=Path(f"{name}.mcap"), joint_names=plant.robot.joint_names, t=np.arange(len(q)) / _RATE,
        position=position, velocity=velocity, effort=torque, reference_position=q, planned_position=plan,
        sample_rate=_RATE, stamp=1e9 + seed % 1000, segments=((0, len(q)),), cycle_starts=(0.0, _CYCLE),
    )  # fmt: skip


def _second_world() -> Iterator[Run]:
    """Two-joint arms of the second world, with its laws, servos and recorders."""
    from agent.estimation import estimate
    from agent.recording import read_log
    from agent.robot import load_robot
    from second_world import world
    from second_world.__main__ import run
    from second_world.arms import ArmClass
    from second_world.draw import draw_cases

    small = ArmClass(
        "two_joints", ((0, 0, 0.3), (0.3, 0, 0)), "zy", (12, 6), (60, 40), (2.2, 2.6), (0.8, 0.5), 100.0, (0.05, 0.12)
    )
    with mock.patch.object(world, "CLASSES", (small,) * 4), tempfile.TemporaryDirectory() as folder:
        for case in draw_cases(28, 20, "development"):
            place = Path(folder) / str(case["number"])
            common = {"machine": case["machine"], "cycle": 3.5}
            try:
                where = place / "robot"
                run(common | {"motion": 4, "effects": [], "folder": place / "baseline", "describe": where})
                run(common | {"motion": case["motion"], "effects": case["effects"], "folder": place / "logs"})
                robot = load_robot(where)
                baseline, logs = (
                    [_in_memory(read_log(path, robot)) for path in sorted((place / part).glob("*.mcap"))]
                    for part in ("baseline", "logs")
                )
                model = estimate(robot, baseline)
            except Exception as error:  # laws that need more joints
                print(f"left out: {[e['effect'] for e in case['effects']]}: {error!r}", file=sys.stderr)
                continue
            name = "+".join(e["effect"] for e in case["effects"]) or "healthy"
            yield Run(f"second world {case['number']} {name}", robot, model, tuple(logs))


def _real() -> Iterator[Run]:
    """A pendulum with a servo, and a linear drive; none without the measured data."""
    from agent.estimation import estimate
    from agent.recording import import_log, read_log
    from agent.robot import load_robot

    source = SHARED / "real-dev/bam_xl330"
    if not source.is_dir():
        return
    robot = load_robot(source / "robot.yaml")
    motions = ("sin_sin", "up_and_down", "sin_time_square", "lift_and_drop")
    logs = {
        (gain, motion): _in_memory(read_log(source / f"kp{gain}_{motion}.mcap", robot))
        for gain in (200, 400) for motion in motions
    }  # fmt: skip
    for gain, other in ((200, 400), (400, 200)):
        for pair in (motions[:2], motions[2:]):
            model = estimate(robot, [logs[gain, motion] for motion in pair])
            yield Run(f"XL330 {gain} by {other} {pair[0]}", robot, model, tuple(logs[other, m] for m in pair))
    examples = ROOT / "recipes/examples/emps"
    robot = load_robot(examples / "robot.yaml")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "emps.mcap"
        import_log(robot, examples / "map.yaml", [SHARED / "emps/DATA_EMPS.mat"], out)
        whole = _in_memory(read_log(out, robot))
    middle = float(whole.t[-1]) / 2
    halves = whole.between(whole.t[0], middle), whole.between(middle, whole.t[-1] + 1)
    for first, second in (halves, halves[::-1]):
        yield Run("EMPS half by half", robot, estimate(robot, [first]), (second,))


def _in_memory(log: Any) -> Any:
    return replace(log, scratch=type(log.scratch)())


# ---------------------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Answer:
    """What a diagnosis says; only this is compared."""

    answer: tuple[Any, ...]
    probability: float


def answer_of(data: bytes) -> Answer:
    """Of one run, from its pickle, so that nothing that is remembered in it survives."""
    from agent.diagnosis import diagnose, with_healthy_effects
    from agent.simulators import load_simulator

    run = pickle.loads(data)
    try:
        if run.file:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / ("arm.xml" if "<mujoco" in run.file else "arm.urdf")
                path.write_text(run.file, encoding="utf-8")
                simulator = load_simulator(path, run.robot, run.logs[0].joint_names, None)
                result = diagnose(run.robot, run.logs, simulator.model, simulator=simulator).result
        else:
            model = with_healthy_effects(run.model, run.baseline) if run.baseline else run.model
            diagnosis = diagnose(run.robot, run.logs, model, drives_off=run.drives_off)
            if run.problem is not None:
                return _planned(diagnosis, run.problem)
            result = diagnosis.result
    except Exception as error:  # a number that makes it fail changes the answer
        return Answer((type(error).__name__,), 0.0)
    first = result["causes"][0] if result["causes"] else {}
    where = result["where"][0]["joint"] if result["where"] else ""
    named = (result["verdict"], first.get("effect", ""), *first.get("joints", ()))
    return Answer((*named, where if result["verdict"] != "no_gap" else ""), float(first.get("probability") or 0.0))


def _plans(name: str) -> bool:
    """Whether a further motion is planned in a run of this name."""
    return name.endswith("experiment")


def _planned(diagnosis: Any, problem: Any) -> Answer:
    """What a further motion of the bare arm settles, and whether a mass is asked for; the lowest probability after."""
    from agent.core import Console
    from agent.experiment import known_mass, open_pairs, plan_experiment

    pairs = open_pairs(diagnosis)
    planned = plan_experiment(diagnosis, pairs, problem, known_mass.LONGEST)
    helps = any(known_mass.makes_answer_likely(expected) for expected in planned.expected)
    mass = None if helps else known_mass.plan_with_mass(diagnosis, pairs, problem, 1, Console(verbosity=-1))
    asked = [(expected.pair.first.text(), expected.pair.second.text()) for expected in planned.expected]
    return Answer((helps, mass is not None, *asked), min((e.after for e in planned.expected), default=0.0))


class Bench:
    """The runs, their answers as the numbers are, and the lines that each executes."""

    def __init__(self, count: int):
        RUNS.parent.mkdir(parents=True, exist_ok=True)
        if not RUNS.exists():
            RUNS.write_bytes(pickle.dumps([(run.name, pickle.dumps(run)) for run in make_runs(count)]))
        runs = pickle.loads(RUNS.read_bytes())
        named = runs[:count] + [(name, data) for name, data in runs[count:] if _plans(name)]
        self.names, self.data = [name for name, _ in named], [data for _, data in named]
        self.usual: list[Answer] = []
        self.lines: list[set[tuple[str, int]]] = []
        for name, data in named:
            answer, lines = self._traced(data)
            print(name, answer, flush=True)
            self.usual.append(answer)
            self.lines.append(lines)

    def _traced(self, data: bytes) -> tuple[Answer, set[tuple[str, int]]]:
        """Answer of a run, and the lines that it comes to."""
        from coverage import Coverage

        for module in [m for name, m in list(sys.modules.items()) if name.startswith("agent.")]:
            _forget(module)
        watch = Coverage(data_file=None, source=[str(ROOT / package) for package in PACKAGES])
        watch.start()
        try:
            answer = answer_of(data)
        finally:
            watch.stop()
        seen = watch.get_data()
        return answer, {(path, line) for path in seen.measured_files() for line in seen.lines(path) or ()}

    def executed(self, site: Site) -> list[int]:
        """Runs that come to a line that reads the number, at most `ENOUGH`: those of its effect or way to record, then
        some of all."""
        lines = self._readers(site)
        reaching = [number for number, seen in enumerate(self.lines) if lines & seen]
        own = [k for k in reaching if self.names[k].split()[-1] in site.path]
        others = [k for k in reaching if k not in own and not (own and _plans(self.names[k]))]
        others = [k for k in others if " " in self.names[k]] or others  # other ways to record are for what they reach
        spread = np.unique(np.linspace(0, len(others) - 1, max(ENOUGH - len(own), 0)).astype(int)) if others else ()
        return [*own, *(others[k] for k in spread)][:ENOUGH]

    def _readers(self, site: Site) -> set[tuple[str, int]]:
        if site.symbol is None:
            return {(str(ROOT / site.path), line) for line in self._span(site)}
        if site.kind != "module":
            return self._by_symbol.get(site.symbol, set())
        holding = _holding(site)
        following = [(owner, name) for module in holding for owner, name, _ in _followers(module, site.symbol)]
        names = {site.symbol, *(name for _, name in following)}
        files = {module.__file__ for module in holding}
        anywhere = {name for owner, name in following if isinstance(owner, type)}  # an attribute is read where it is
        read = ((name, at) for name in names for at in self._by_symbol.get(name, set()))
        return {at for name, at in read if name in anywhere or at[0] in files}

    def _span(self, site: Site) -> set[int]:
        """Lines of the statements that hold an inline number."""
        lines: set[int] = set()
        for node in ast.walk(ast.parse((ROOT / site.path).read_text("utf-8"))):
            whole = isinstance(node, ast.expr) or (isinstance(node, ast.stmt) and not hasattr(node, "body"))
            if whole and node.lineno <= site.line <= (node.end_lineno or node.lineno):
                lines |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        return lines

    @cached_property
    def _by_symbol(self) -> dict[str, set[tuple[str, int]]]:
        known: dict[str, set[tuple[str, int]]] = {}
        for package in PACKAGES:
            for path in (ROOT / package).rglob("*.py"):
                nodes = ast.walk(ast.parse(path.read_text("utf-8")))
                functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
                for function in functions:  # a default is read where the body begins
                    for name in (node.id for node in function.args.defaults if isinstance(node, ast.Name)):
                        known.setdefault(name, set()).update((str(path), part.lineno) for part in function.body[:2])
                for node in (node for function in functions for part in function.body for node in ast.walk(part)):
                    name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)
                    if name and isinstance(node.ctx, ast.Load):
                        span = range(node.lineno, (node.end_lineno or node.lineno) + 1)
                        known.setdefault(name, set()).update((str(path), line) for line in span)
        return known

    def measured(self, site: Site) -> dict[str, Any]:
        """A line of the table."""
        ran = self.executed(site)
        row: dict[str, Any] = {"number": site.key, "value": site.value, "runs": len(self.data), "executed": len(ran)}
        for name, factor in (("half", 0.5), ("double", 2.0)):
            with changed(site, factor):
                answers = [answer_of(self.data[number]) for number in ran]
            pairs = [(self.usual[number], now) for number, now in zip(ran, answers, strict=True)]
            row[f"{name}_answers"] = sum(a.answer != b.answer for a, b in pairs)
            row[f"{name}_probabilities"] = sum(
                a.answer == b.answer and abs(a.probability - b.probability) > _MOVED for a, b in pairs
            )
        return row


def table() -> dict[str, dict[str, str]]:
    """Lines that are measured, by number."""
    if not TABLE.exists():
        return {}
    with TABLE.open(encoding="utf-8") as file:
        return {row["number"]: row for row in csv.DictReader(file)}


def main() -> None:
    """Give every number a line, measure what is asked for, then write the page."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--runs", type=int, default=0, help="of the fixed set; 0 measures nothing")
    arguments.add_argument("--seconds", type=float, default=float("inf"), help="CPU seconds, after which it stops")
    arguments.add_argument("--only", default="", help="regular expression of numbers")
    asked = arguments.parse_args()
    known, rows = sites(), table()
    rows = {
        site.key: row if (row := rows.get(site.key)) and row["value"] == site.value else _unmeasured(site)
        for site in known
    }
    _write(list(rows.values()))
    bench = Bench(asked.runs) if asked.runs else None
    began = time.process_time()
    for site in sorted(known, key=_last) if bench else ():
        wanted = re.search(asked.only, site.key) and not site.path.startswith(FIGURES) and site.claims != "derived"
        if wanted and int(rows[site.key]["runs"]) < len(bench.data) and time.process_time() - began < asked.seconds:
            rows[site.key] = bench.measured(site)
            print(rows[site.key], round(time.process_time() - began), flush=True)
            _write(list(rows.values()))


def _unmeasured(site: Site) -> dict[str, Any]:
    return {"number": site.key, "value": site.value, "runs": 0, **dict.fromkeys(COLUMNS[3:], "")}


def _last(site: Site) -> int:
    """What claims to be numerical comes first, then what decides."""
    if site.claims == "numerical":
        return -1
    order = ("limits.py", "law.py", "evidence.py", "verdict.py", "search.py", "noise_model.py", "adequacy.py", "rows/")
    return next((place for place, name in enumerate(order) if name in site.path), len(order))


def kind_of(site: Site, row: dict[str, Any]) -> str:
    """What a number is: derived, numerical, of figures, or one that decides."""
    if site.path.startswith(FIGURES):
        return "figures"
    if site.claims != "numerical":
        return site.claims or "decides"
    return "numerical" if int(row["runs"]) and int(row["executed"]) and not _changes(row) else "decides"


def _changes(row: dict[str, Any]) -> int:
    """Runs that a number changes."""
    return sum(int(row[name] or 0) for name in COLUMNS[4:])


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown text of the table."""
    known = {site.key: site for site in sites()}
    of_kind: dict[str, list[dict[str, Any]]] = {"decides": [], "numerical": [], "derived": [], "figures": []}
    for row in rows:
        of_kind[kind_of(known[row["number"]], row)].append(row)
    deciding = of_kind["decides"]
    measured = [row for row in deciding if int(row["runs"])]
    idle = [row for row in measured if not int(row["executed"])]
    text = [
        "# Numbers of a diagnosis",
        "",
        "Each number is halved and doubled while small runs are diagnosed: emulated arms, arms of another world, and",
        "logs of real arms. `2 + 1` means: the verdict, the first cause or the first joint differs in two runs. The",
        "probability of the first cause moves by over 0.05 in one further run. `3 of 20` runs: the number is varied in",
        "three runs that come to it, of a set of 20. `benchmarks/sensitivity.py` writes this page and says which",
        "numbers are left out. No number is chosen by it.",
        "",
        f"{len(deciding)} numbers decide: {len(measured)} measured, of which {sum(map(bool, map(_changes, measured)))} "
        f"change an answer or a probability and {len(idle)} are in code that no run reaches. "
        f"{len(of_kind['numerical'])} are numerical, {len(of_kind['derived'])} derived and "
        f"{len(of_kind['figures'])} of figures.",
    ]
    for package in PACKAGES:
        text += _table(package, [row for row in deciding if known[row["number"]].path.startswith(f"{package}/")], known)
    text += _table("Numerical: halved and doubled, they change nothing", of_kind["numerical"], known)
    text += _table("Derived from a formula or a definition", of_kind["derived"], known)
    text += _table("Of figures: no verdict, cause or probability is made of them", of_kind["figures"], known)
    return "\n".join([*text, ""])


def _table(title: str, rows: Sequence[dict[str, Any]], known: dict[str, Site]) -> list[str]:
    text = ["", f"## {title}", "", "| number | value | unit and source | runs | halved | doubled |"]
    text += ["| --- | --- | --- | --- | --- | --- |"]
    for row in rows:
        said = known[row["number"]].comment.replace("|", "\\|")
        cells = (f"`{row['number']}`", f"`{row['value']}`", said, *_outcome(row))
        text.append("| " + " | ".join(cells) + " |")
    return text


def _outcome(row: dict[str, Any]) -> tuple[str, str, str]:
    if not int(row["runs"]):
        return "", "not measured", "not measured"
    if not int(row["executed"]):
        return f"0 of {row['runs']}", "not reached", "not reached"
    both = (f"{row[f'{name}_answers']} + {row[f'{name}_probabilities']}" for name in ("half", "double"))
    half, double = ("nothing" if text == "0 + 0" else text for text in both)
    return f"{row['executed']} of {row['runs']}", half, double


def _write(rows: Sequence[dict[str, Any]]) -> None:
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    PAGE.write_text(page(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
