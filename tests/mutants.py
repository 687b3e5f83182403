"""`python tests/mutants.py MODULE…`: change one thing at a time in a module, and list the changes that no test notices.

mutmut makes the changes, in a copy of the tree under `.verify/mutants/`, and keeps what it has tried there: an
interrupted run goes on where it stopped, and only survivors and functions that changed since are tried again.
"""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Packages whose numbers somebody relies on, and the tests that have to notice a change in them.
PACKAGES = {
    "agent/diagnosis": ["tests/diagnosis"],
    "agent/estimation": ["tests/estimation"],
    "agent/pages": ["tests/validation", "tests/shop_floor/test_pages.py"],
    "agent/runs": ["tests/shop_floor/test_trends.py", "tests/shop_floor/test_history.py"],
    "agent/validation": ["tests/validation"],
}
_LOG_EVIDENCE = ["tests/diagnosis/test_log_evidence.py"]
_OF_EVIDENCE = ("evidence", "joint_moments", "noise_model", "pool", "score")
_DECISION = ["tests/diagnosis/test_verdict.py", "tests/diagnosis/test_posterior.py"]
#: The same for modules that no file of tests is called after, where those of the package say little of them.
NARROW = {
    "agent/diagnosis/forward/interval.py": ["tests/diagnosis/test_forward.py"],
    **{
        f"agent/diagnosis/hypotheses/{name}.py": _LOG_EVIDENCE
        for name in ("evidence", "joint_moments", "noise_model", "pool", "score")
    },
    "agent/diagnosis/hypotheses/selected_causes.py": _DECISION,
    "agent/diagnosis/rows/moments.py": ["tests/diagnosis/test_fit.py"],
    "agent/diagnosis/verdict.py": _DECISION,
    "agent/estimation/uncertainty.py": ["tests/estimation/test_uncertainty.py", "tests/estimation/test_paper.py"],
    "agent/pages/calibration/parameters.py": ["tests/validation/test_run_sections.py"],
}
#: Changes that give the same results, by module and reason: parts of the lines that they make.
EQUIVALENT = tomllib.loads((ROOT / "tests/equivalent_mutants.toml").read_text("utf-8"))
_LINKED = ("agent", "drivers", "fake_controller", "second_world", "recipes", "docs", "tests")
_SETTINGS = """
[tool.mutmut]
source_paths = ["agent", "drivers", "fake_controller", "second_world"]
only_mutate = ["{module}"]
also_copy = ["recipes", "docs"]
pytest_add_cli_args = ["-m", "not verify", "-p", "no:cacheprovider", "--hypothesis-profile=all"]
pytest_add_cli_args_test_selection = {tests}
do_not_mutate_patterns = ["raise ", "errstate", "strict=True"]
use_git_change_detection = false
timeout_multiplier = 30  # a machine with other work is no endless loop
"""
_NOTICED = (1, 3, 24, 36, 152, 255, -24)  # exit codes: a test failed, or took far too long
_DIFFERENCES = """
import sys
from mutmut.mutation.diff_apply import find_mutant, get_diff_for_mutant
for name in sys.argv[1:]:
    print("\\0" + name, get_diff_for_mutant(name, path=find_mutant(name).path), sep="\\n")
"""


def modules() -> list[str]:
    """All modules of these packages, by path."""
    return [
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.name != "__init__.py"
    ]


def tests_of(module: str) -> list[str]:
    """The tests that are called after a module, where there are any; else those of its package."""
    package = PACKAGES["/".join(module.split("/")[:2])]
    folder = package[0].rpartition("/test_")[0] or package[0]
    named = f"{folder}/test_{Path(module).name}"
    return NARROW.get(module) or ([named] if (ROOT / named).exists() else package)


def survivors(module: str) -> tuple[int, list[str]]:
    """How many changes of a module were tried, and those that no test noticed, as differences of its text.

    Raises:
        RuntimeError: the tests fail on the unchanged module.
    """
    folder = ROOT / ".verify/mutants" / module.removesuffix(".py").replace("/", ".")
    folder.mkdir(parents=True, exist_ok=True)
    for name in _LINKED:
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)
    tests = tests_of(module)
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8") + _SETTINGS.format(module=module, tests=tests)
    (folder / "pyproject.toml").write_text(settings, encoding="utf-8")
    for noted in folder.glob(f"mutants/{module}.meta"):
        tried = json.loads(noted.read_text(encoding="utf-8"))
        codes = tried["exit_code_by_key"]
        tried["exit_code_by_key"] = {name: code if code in _NOTICED else None for name, code in codes.items()}
        noted.write_text(json.dumps(tried), encoding="utf-8")
    (folder / "mutants/mutmut-stats.json").unlink(missing_ok=True)  # a test may call other functions than before
    done = _mutmut(folder, "run", "--max-children", str(len(os.sched_getaffinity(0))))
    if done.returncode:
        raise RuntimeError(f"{module}: mutmut gave up\n{done.stdout[-3000:]}")
    states = dict(line.strip().rsplit(": ", 1) for line in _mutmut(folder, "results", "--all", "1").stdout.splitlines())
    alive = [name for name, state in states.items() if state not in ("killed", "timeout")]
    found = _run(folder, "-c", _DIFFERENCES, *alive).stdout.split("\0")[1:]
    return len(states), [change for change in found if not _same(module, change)]


def _same(module: str, change: str) -> bool:
    lines = [line for line in change.splitlines() if line.startswith("+") and not line.startswith("+++")]
    known = [part for parts in EQUIVALENT.get(module, {}).values() for part in parts]
    return any(part in line for line in lines for part in known)


def _mutmut(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return _run(folder, "-m", "mutmut", *arguments)


def _run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def main(chosen: list[str]) -> int:
    """0 if every change is noticed."""
    left = 0
    for module in chosen or modules():
        tried, alive = survivors(module)
        left += len(alive)
        print(*alive, f"{module}: {tried - len(alive)} of {tried} changes noticed", sep="\n", flush=True)
    return int(left > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
