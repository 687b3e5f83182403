"""Takes the checks of the safety layer away, one at a time, and sees that a test of the guard fails each time.

Every `if` is made never true and negated, every statement that calls a check or a stop is left out, every returned
condition is negated, and every comparison by size is written by its opposite (`a < b` as not `a >= b`), which makes a
difference for what is no number. `python tests/safety/mutation.py [MODULE…]` lists the survivors; there must be none.
A change is tried with the tests that run its lines.
"""

import ast
import copy
import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FrameType, ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
TESTS = [
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("tests/safety/test_guard*.py")),
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("tests/robot/test_cell*.py")),
    "tests/safety/test_sample_matching.py",
    "tests/link/test_frames_before_motion.py",
    "tests/shop_floor/test_authorisation.py",
]
#: Of the robot, what keeps it clear of itself and of boxes.
CLEARANCE = ("agent/robot/cell.py", "agent/robot/clearance.py")
MODULES = [
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("agent/safety/*.py") if path.name != "__init__.py"),
    *CLEARANCE,
]
_LAYER = tuple(f"/{module}" for module in MODULES)
#: Heavy modules are imported once, for all children; none of the layer itself.
HEAVY = (
    "hypothesis",
    "scipy.interpolate",
    "agent.motion",
    "agent.motion.pdl2.reader",
    "agent.recipe.schema",
    "agent.robot.dynamics",
    "agent.runs.folder",
    "drivers.transports.tcp.driver",
)
#: A change that hangs is noticed: after a time [s], and after a multiple of the duration of its tests.
LIMIT, TIMES = 30.0, 5.0
MEMORY = 4 << 30  # bytes; a change that takes more is noticed
#: Calls that build a message or move a loop on, and check nothing.
_HARMLESS_CALLS = {"append", "mkdir"}
_OPPOSITE = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}


#: Comparisons of values that are never NaN, or that choose words: equivalent to their opposites for every test.
ALWAYS_NUMBERS: dict[str, dict[str, str]] = {
    "adherence.py": {
        "len(chains) > 1": "a count",
        "len(self._waiting) < _BLOCKS": "a count",
        "float(block.time[-1]) - float(self._waiting[0].time[0]) < BATCH_DURATION": "no number waits a little longer",
        "np.diff(time, prepend=self._last) > GAP": "of times that are numbers",
        "interval > GAP": "of times that are numbers",
        "passed.max() <= GAP": "of times that are numbers",
        "np.abs(values[:, None] - planned) <= within": "where the tool's distance is a number",
        "farthest <= within.min()": "the same",
        "self._path.stops >= points[0]": "indices",
        "self._path.stops <= points[-1]": "indices",
        "self._last - self._stands_since <= self._longest_rest": "of times that are numbers",
        "self._path.distance(tool, rows) <= margin + allowed.tool": "where the joints' distances are numbers",
        "points >= begin[:, None]": "indices",
        "points <= end[:, None]": "indices",
        "speed > allowed.resting * self._robot.max_velocity": "of positions that are numbers",
        "np.abs(np.radians(position) - q) <= allowed.joint": "of positions that are numbers",
        "abs(took - planned) <= ALLOWANCE + SHARE * min(took, planned)": "of times that are numbers",
        "planned > RESYNC_AFTER": "of times that are numbers",
    },
    "authorisation.py": {
        "remaining <= _SOON": "dates",
        "document.expires <= latest": "dates",
        "(now or datetime.now(UTC)).date() <= document.expires": "dates",
    },
    "cell.py": {"widest < 0": "of distances that were found to be numbers"},
    "clearance.py": {
        "self.margin > 0": "a margin that was found to be a number",
        "np.where(is_open, along, 0.0).max(axis=1) >= np.where(is_open, aside, 0.0).max(axis=1)": "finite positions",
        "distances - along - aside >= self.margin": "of distances that were found to be large enough",
        "middle[row, 0] < self.first[0]": "indices",
        "middle[row, 1] > 0": "indices",
        "stretches[:, :1] < (np.inf if self.first is None else self.first[0] - 1.0)": "indices",
        "bounds < target": "of distances that were found to be numbers",
        "bounds < self.margin - self.tolerance": "of distances that were found to be numbers",
        "short.min(axis=1) >= 0": "of distances that were found to be numbers",
    },
    "freshness.py": {
        "silent < PROCESS_STALL": "chooses the words",
    },
    "planned_program.py": {"np.ptp(chain.q, axis=0).max() < ARRIVED_WITHIN": "of a plan that was checked"},
    "reference_path.py": {
        "passed[k] > gap": "of times that are numbers",
        "np.diff(indices) > 1": "indices",
        "window.start < window.stop": "indices",
        "distance <= min(distances) + within": "of times that are numbers",
        "period > 0": "of a plan that was checked",
        "times <= latest + ahead + self.step": "of times that are numbers",
    },
    "preconditions.py": {
        "np.abs(np.radians(position) - program.chains[0].q[0]) <= START_TOLERANCE": "chooses the words"
    },
    "stuck_positions.py": {
        "len(self._blocks) > 1": "a count",
        "self._blocks[1].time[0] <= self._blocks[-1].time[-1] - FREEZE_WINDOW": "of times that are numbers",
        "since >= 0": "an index",
        "np.max(np.diff(time[since:]), initial=0.0) <= self._gap": "of times that are numbers",
    },
    "stopping.py": {
        "0.0 <= times[0] - self._times[-1] <= 10 * SPEED_WINDOW": "of times that are numbers",
        "self._braking.stationary_time < MISSING_END_AFTER": "of times that are numbers",
    },
    "watch.py": {
        "now - self._looked < WATCH_INTERVAL": "of times that the driver has checked",
        "self._clock() - self._looked_at < WATCH_INTERVAL": "of this machine's clock",
        "int(block.sequence[-1]) <= self._last": "counts",
        "remaining <= EARLY_END_TOLERANCE": "of a plan that was checked",
        "remaining <= EARLY_END_TOLERANCE + lost": "the same, and counts",
        "gap.first > last": "counts",
        "now - self.temperatures[-1][0] <= interval": "of times that the driver has checked",
    },
}

#: Conditions of a quick path that gives the same as a slow one; a test compares the two.
QUICK_PATHS = {"reference_path.py": {"whole and one_run[k]": "tests/safety/test_sample_matching.py"}}


@dataclass(frozen=True)
class Mutant:
    """One change of one module: where, what was done, and the whole text."""

    module: str
    line: int
    last: int
    what: str
    text: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.what}"


def mutants(modules: list[str]) -> Iterator[Mutant]:
    """All changes of these modules."""
    for module in modules:
        tree = ast.parse((ROOT / module).read_text(encoding="utf-8"))
        scope = {
            id(node)
            for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef)
            for node in ast.walk(function)
        }
        places = [
            (index, what)
            for index, node in enumerate(ast.walk(tree))
            if id(node) in scope
            for what in _changes(node, Path(module).name)
        ]
        for index, what in places:
            changed = copy.deepcopy(tree)
            node = list(ast.walk(changed))[index]
            line, last, said = node.lineno, node.end_lineno, ast.unparse(node).splitlines()[0]
            if isinstance(node, ast.If):
                last = node.test.end_lineno
            changed = _Change(node, what).visit(changed)
            yield Mutant(module, line, last, f"{what}: {said}", ast.unparse(ast.fix_missing_locations(changed)))


def _changes(node: ast.AST, module: str) -> tuple[str, ...]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _OPPOSITE:
        return () if ast.unparse(node) in ALWAYS_NUMBERS.get(module, {}) else ("by its opposite",)
    if isinstance(node, (ast.If, ast.IfExp)):
        return ("negated",) if ast.unparse(node.test) in QUICK_PATHS.get(module, {}) else ("never", "negated")
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
        if isinstance(node, ast.Compare):
            return _by_its_opposite(node)
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


def _by_its_opposite(node: ast.Compare) -> ast.AST:
    """As `node`, of numbers and of arrays, where both sides are numbers."""
    pairs = zip([node.left, *node.comparators], node.ops, node.comparators, strict=False)
    denied = [
        ast.Call(
            ast.parse("__import__('numpy').logical_not", mode="eval").body,
            [ast.Compare(left, [_OPPOSITE[type(op)]()], [right])],
            [],
        )
        for left, op, right in pairs
    ]
    return denied[0] if len(denied) == 1 else ast.BoolOp(ast.And(), denied)


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


class _Reached:
    """A plugin of pytest that writes down which lines of the layer each test runs, and how long each takes [s]."""

    def __init__(self, path: Path):
        self._path = path
        self._test = ""
        self._lines: dict[str, set[tuple[str, int]]] = defaultdict(set)
        self._seconds: dict[str, float] = {}

    def pytest_configure(self) -> None:
        """From here on; what is run while tests are gathered belongs to none."""
        threading.settrace(self._call)
        sys.settrace(self._call)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """One test with all its fixtures."""
        self._test, began = item.nodeid, time.monotonic()
        sys.settrace(self._call)
        result = yield
        self._seconds[item.nodeid] = time.monotonic() - began
        return result

    def pytest_unconfigure(self) -> None:
        """Once, at the end."""
        sys.settrace(None)
        lines = {test: sorted(places) for test, places in self._lines.items() if test}
        self._path.write_text(json.dumps({"lines": lines, "seconds": self._seconds}), encoding="utf-8")

    def _call(self, frame: FrameType, event: str, argument: object) -> object:
        return self._line if frame.f_code.co_filename.endswith(_LAYER) else None

    def _line(self, frame: FrameType, event: str, argument: object) -> object:
        module = Path(frame.f_code.co_filename).relative_to(ROOT).as_posix()
        self._lines[self._test].add((module, frame.f_lineno))
        return self._line


class _Chosen:
    """A plugin of pytest that runs these tests alone, in this order."""

    def __init__(self, tests: list[str]):
        self._rank = {test: rank for rank, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Of all that was gathered."""
        chosen = [item for item in items if item.nodeid in self._rank]
        items[:] = sorted(chosen, key=lambda item: self._rank[item.nodeid])


def passes(mutant: Mutant | None, files: list[str], limit: float, plugins: tuple[object, ...] = ()) -> bool:
    """Whether the tests of these files pass with a change (None: with none), in a child that imports the layer anew."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        if mutant is not None:
            sys.meta_path.insert(0, _Loader(mutant))
        options = ["-x", "-q", "-m", "not verify", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml")]
        options.append("--hypothesis-profile=all")
        os._exit(int(pytest.main([*options, *files], plugins=list(plugins))))
    until = time.monotonic() + limit
    while time.monotonic() < until:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status) in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


class Reach:
    """Which tests run which lines, from one run of all of them on the layer as it is.

    Raises:
        RuntimeError: they fail.
    """

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            written = Path(folder) / "reached.json"
            if not passes(None, TESTS, 1800.0, (_Reached(written),)):
                raise RuntimeError("the tests fail on the unchanged layer")
            reached = json.loads(written.read_text(encoding="utf-8"))
        self._seconds: dict[str, float] = reached["seconds"]
        self._tests: dict[tuple[str, int], set[str]] = defaultdict(set)
        for test, places in reached["lines"].items():
            for module, line in places:
                self._tests[module, line].add(test)

    def notices(self, mutant: Mutant) -> bool:
        """Whether a test that runs its lines fails, the quickest first."""
        lines = range(mutant.line, mutant.last + 1)
        tests = set().union(*(self._tests[mutant.module, line] for line in lines))
        files = sorted({test.partition("::")[0] for test in tests})
        limit = LIMIT + TIMES * sum(self._seconds[test] for test in tests)
        chosen = _Chosen(sorted(tests, key=self._seconds.__getitem__))
        return bool(tests) and not passes(mutant, files, limit, (chosen,))


def ready() -> None:
    """Import heavy modules, and none of the layer.

    Raises:
        RuntimeError: something of the layer is, so it cannot be changed.
    """
    os.chdir(ROOT)
    for name in HEAVY:
        importlib.import_module(name)
    changeable = {module.removesuffix(".py").replace("/", ".") for module in MODULES}
    early = sorted(changeable & set(sys.modules))
    if early:
        raise RuntimeError(f"imported too early to be changed: {early}")


def main(chosen: list[str]) -> int:
    """0 if every change is noticed."""
    modules = [name for name in MODULES if not chosen or Path(name).stem in {Path(one).stem for one in chosen}]
    if len(modules) < len(chosen):
        print(f"not all of {' '.join(chosen)} are modules of the safety layer")
        return 2
    ready()
    reach = Reach()
    survivors, count = 0, 0
    for mutant in mutants(modules):
        count += 1
        noticed = reach.notices(mutant)
        survivors += not noticed
        print(f"{'noticed ' if noticed else 'SURVIVED'} {mutant}", flush=True)
    print(f"{count - survivors} of {count} changes noticed")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
