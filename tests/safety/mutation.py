"""Takes the checks of the safety layer away, one at a time, and sees that a test of the guard fails each time.

Every `if` is made never true and negated, every statement that calls a check or a stop is left out, every returned
condition is negated. `python tests/safety/mutation.py` lists the survivors; there must be none.
"""

from __future__ import annotations

import ast
import copy
import importlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
TESTS = sorted(str(path) for path in ROOT.glob("tests/safety/test_guard*.py"))
#: Modules of the layer; of one that holds more than that, the functions that belong to it.
MODULES: dict[str, tuple[str, ...]] = {
    "agent/safety/guard.py": (),
    "agent/safety/watch.py": (),
    "agent/safety/preconditions.py": (),
    "agent/safety/checked.py": (),
    "agent/safety/adherence.py": (),
    "agent/safety/planned_path.py": (),
    "agent/safety/patience.py": (),
    "agent/safety/motion.py": (),
    "agent/safety/first_run.py": (),
    "agent/safety/authorisation.py": ("check",),
}
#: What is heavy is imported once, for all children; nothing of the layer itself.
HEAVY = (
    "hypothesis",
    "scipy.interpolate",
    "agent.motion",
    "agent.motion.pdl2.reader",
    "agent.recipe.schema",
    "agent.robot.dynamics",
    "agent.runs.folder",
    "drivers.transports.tcp",
)
LIMIT = 120.0  # s; a change that hangs is noticed
#: Calls that build a message or move a loop on, and check nothing.
_HARMLESS_CALLS = {"append", "mkdir"}


@dataclass(frozen=True)
class Mutant:
    """One change of one module: where, what was done, and the whole text."""

    module: str
    line: int
    what: str
    text: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.what}"


def mutants() -> Iterator[Mutant]:
    """All changes."""
    for module, functions in MODULES.items():
        tree = ast.parse((ROOT / module).read_text(encoding="utf-8"))
        scope = [
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef) and (not functions or node.name in functions)
        ]
        places = {
            (index, what)
            for function in scope
            for index, node in enumerate(ast.walk(tree))
            if node in list(ast.walk(function))
            for what in _changes(node)
        }
        for index, what in sorted(places):
            changed = copy.deepcopy(tree)
            node = list(ast.walk(changed))[index]
            line, said = node.lineno, ast.unparse(node).splitlines()[0]
            changed = _Change(node, what).visit(changed)
            yield Mutant(module, line, f"{what}: {said}", ast.unparse(ast.fix_missing_locations(changed)))


def _changes(node: ast.AST) -> tuple[str, ...]:
    if isinstance(node, (ast.If, ast.IfExp)):
        return ("never", "negated")
    if isinstance(node, ast.BoolOp):
        return tuple(f"without part {k + 1}" for k in range(len(node.values)))
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        name = node.value.func.attr if isinstance(node.value.func, ast.Attribute) else ""
        return () if name in _HARMLESS_CALLS else ("left out",)
    if isinstance(node, ast.Return) and isinstance(node.value, (ast.BoolOp, ast.Compare, ast.UnaryOp)):
        return ("negated",)
    return ()


class _Change(ast.NodeTransformer):
    def __init__(self, target: ast.AST, what: str):
        self._target = target
        self._what = what

    def visit(self, node: ast.AST) -> ast.AST:
        if node is not self._target:
            return self.generic_visit(node)
        if self._what == "left out":
            return ast.Pass()
        if self._what.startswith("without part"):
            del node.values[int(self._what.split()[-1]) - 1]
            return node.values[0] if len(node.values) == 1 else node
        if isinstance(node, ast.Return):
            node.value = ast.UnaryOp(ast.Not(), node.value)
        elif self._what == "never":
            node.test = ast.Constant(False)
        else:
            node.test = ast.UnaryOp(ast.Not(), node.test)
        return node


class _Loader:
    """Gives one module another text; put first among the finders of a child process."""

    def __init__(self, mutant: Mutant):
        self._name = mutant.module.removesuffix(".py").replace("/", ".")
        self._text = mutant.text

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Only for the module that is changed."""
        return ModuleSpec(name, self) if name == self._name else None

    def create_module(self, spec: ModuleSpec) -> None:
        """The usual one."""

    def exec_module(self, module: ModuleType) -> None:
        """Run the changed text."""
        exec(compile(self._text, f"<changed {self._name}>", "exec"), module.__dict__)


def survives(mutant: Mutant | None) -> bool:
    """Whether the tests pass with this change (None: with none), in a child that imports the layer anew."""
    child = os.fork()
    if child == 0:
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        if mutant is not None:
            sys.meta_path.insert(0, _Loader(mutant))
        options = ["-x", "-q", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml")]
        os._exit(int(pytest.main([*options, *TESTS])))
    until = time.monotonic() + LIMIT
    while time.monotonic() < until:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def main() -> int:
    """0 if every change is noticed."""
    for name in HEAVY:
        importlib.import_module(name)
    early = [name for name in sys.modules if name.startswith("agent.safety.")]
    if early:
        print(f"imported too early to be changed: {early}")
        return 2
    if not survives(None):
        print("the tests fail on the unchanged layer")
        return 2
    survivors, count = 0, 0
    for mutant in mutants():
        count += 1
        alive = survives(mutant)
        survivors += alive
        print(f"{'SURVIVED' if alive else 'noticed '} {mutant}", flush=True)
    print(f"{count - survivors} of {count} changes noticed")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
