"""How the source is laid out: what import-linter has no contract for."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import CodeType

import grimp

from agent.model import CATALOGUE

PACKAGES = ("agent", "drivers", "fake_controller", "second_world")
ROOT = Path(__file__).parents[1]


def test_no_module_imports_itself_by_way_of_others():
    """Import-linter compares neighbours; here a package's own `__init__` counts as well, and lazy imports too."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}
    while leaves := {module for module, imported in imports.items() if not imported}:
        imports = {module: imported - leaves for module, imported in imports.items() if module not in leaves}
    assert not imports, f"a circle of imports goes through some of these: {sorted(imports)}"


def test_no_class_name_stands_for_two_things():
    """Classes at the top of a module; private ones too, as they are met in the same tracebacks."""
    places: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for name in re.findall(r"^class (\w+)", path.read_text("utf-8"), re.M):
                places.setdefault(name, []).append(path.relative_to(ROOT).as_posix())
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


#: Leaves: one module each for whoever adds one.
LEAVES = {"agent/model/effects"}


def test_a_folder_has_at_most_twelve_modules():
    """More are not read as one thing; a package in it says what some of them are."""
    modules = [path for package in PACKAGES for path in _modules(package) if path.name != "__init__.py"]
    counts = Counter(path.parent.relative_to(ROOT).as_posix() for path in modules)
    assert {folder: count for folder, count in counts.items() if count > 12 and folder not in LEAVES} == {}


def test_a_package_is_imported_through_its_public_names():
    """Other packages use only the names that a package's `__init__` exports; the rest is private to it. A package in a
    package with a stub of its own has names of its own."""
    inside = []
    for path in (path for package in PACKAGES for path in _modules(package)):
        own = path.relative_to(ROOT).parts[:2]
        for hit in re.finditer(r"(?m)^ *from (agent\.\w+\.[\w.]+) import", path.read_text("utf-8")):
            package = hit[1].split(".")
            if tuple(package[:2]) != own and not ROOT.joinpath(*package, "__init__.pyi").exists():
                inside.append(f"{path.relative_to(ROOT).as_posix()}: {hit[1]}")
    assert inside == []


def test_exported_names_are_used_outside_their_package():
    tops = (*PACKAGES, "tests", "benchmarks", "docs")
    texts = {path: path.read_text("utf-8") for top in tops for path in _modules(top)}
    pages = "\n".join(path.read_text("utf-8") for path in (ROOT / "docs").rglob("*.md"))
    idle = []
    doors = [*(ROOT / "agent").glob("*/__init__.py"), *(ROOT / "agent").rglob("__init__.pyi")]
    for package in sorted({path.parent for path in doors}):
        called = ".".join(package.relative_to(ROOT).parts)
        user = re.compile(rf"{re.escape(called)}\b|from agent import .*\b{package.name}\b")
        outside = "\n".join([pages, *(t for p, t in texts.items() if user.search(t) and package not in p.parents)])
        taken = set(re.findall(r"\w+", outside))
        idle += [f"{called}: {name}" for name in sorted(_offered(package)) if name not in taken]
    assert idle == []


@cache
def _offered(package: Path) -> set[str]:
    """Names that a package exports: of its stub where it loads them on first use (mypy checks that they exist)."""
    door, own = max(package.glob("__init__.py*")), ".".join(package.relative_to(ROOT).parts)
    nodes = [node for node in ast.parse(door.read_text("utf-8")).body if isinstance(node, ast.ImportFrom)]
    return {name.name for node in nodes if node.level or f"{node.module}.".startswith(f"{own}.") for name in node.names}


def test_exported_functions_say_what_their_arguments_are():
    """One or two are said in a sentence; more have a line each."""
    silent = []
    for package in [*(ROOT / "agent").glob("*/__init__.py*"), *(ROOT / "agent").rglob("__init__.pyi")]:
        offered = _offered(package.parent)
        for path, tree in _parsed(package.parent, rf"(?m)^def ({'|'.join(offered)})\b") if offered else ():
            for node in tree.body:
                if isinstance(node, ast.FunctionDef) and node.name in offered:
                    told = re.search("Args:|Parameters", ast.get_docstring(node) or "")
                    if len(node.args.args) + len(node.args.kwonlyargs) > 2 and not told:
                        silent.append(f"{path.relative_to(ROOT).as_posix()}:{node.lineno}: {node.name}")
    assert silent == []


def test_no_module_shadows_an_exported_function():
    """A package loads an exported name on first use; a module of that name, imported before, would replace it."""
    hidden = []
    for package in sorted(path.parent for path in (ROOT / "agent").rglob("__init__.py")):
        modules = {path.stem for path in package.iterdir() if path.suffix == ".py" or path.is_dir()}
        hidden += [f"{package.relative_to(ROOT).as_posix()}: {name}" for name in _offered(package) & modules]
    assert hidden == []


def _modules(top: str | Path) -> list[Path]:
    return sorted((ROOT / top).rglob("*.py"))


def _parsed(top: str | Path, having: str) -> Iterator[tuple[Path, ast.Module]]:
    """Modules whose text has a pattern; parsing all others takes seconds and tells nothing."""
    for path in _modules(top):
        text = path.read_text("utf-8")
        if re.search(having, text):
            yield path, _tree(path)


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def test_no_import_hides_in_a_string():
    """Where a module is named as text no tool sees the import: registries may, and so may a process that is started."""
    hidden = []
    for package in PACKAGES:
        for path, tree in _parsed(package, rf"""["']({"|".join(PACKAGES)})\."""):
            if path.name == "registry.py":
                continue
            nodes = list(ast.walk(tree))
            lists = [node.elts for node in nodes if isinstance(node, ast.List | ast.Tuple)]
            started = {id(b) for entries in lists for a, b in pairwise(entries) if getattr(a, "value", None) == "-m"}
            own = ".".join(path.relative_to(ROOT).parent.parts)  # whose data files a module may open
            for node in nodes:
                text = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
                if names_a_module(text) and id(node) not in started and not f"{own}.".startswith(f"{text}."):
                    hidden.append(f"{path.relative_to(ROOT).as_posix()}:{node.lineno}: {text}")
    assert hidden == []


def names_a_module(text: str) -> bool:
    first, *parts = text.partition(":")[0].split(".")
    if first not in PACKAGES or not parts or not all(parts):
        return False
    place = ROOT.joinpath(first, *parts)
    return place.is_dir() or place.with_suffix(".py").is_file()


def test_search_verdict_and_pages_know_no_effect_by_name():
    """All that is known about an effect is in its class, so that one from outside is treated as the built-in ones."""
    known = {effect.name for effect in CATALOGUE.built_in} | {type(effect).__name__ for effect in CATALOGUE.built_in}
    found = []
    for package in ("diagnosis", "experiment", "pages", "pipeline", "notebook", "fleet", "cli", "simulators/corrected"):
        for path, tree in _parsed(f"agent/{package}", rf"\b({'|'.join(known)})\b"):
            for node in ast.walk(tree):
                name = getattr(node, "value", None) if isinstance(node, ast.Constant) else getattr(node, "id", None)
                if isinstance(name, str) and name in known:
                    found.append(f"{path.relative_to(ROOT).as_posix()}:{node.lineno}: {name}")
    assert found == []


def test_no_fixture_that_tests_share_needs_measured_data():
    """Else a whole folder of tests skips in a fresh clone, and a wrong formula passes there."""
    needing = [
        path.relative_to(ROOT).as_posix()
        for path in sorted((ROOT / "tests").rglob("conftest.py"))
        if path.parent != ROOT / "tests" and "shared_data" in path.read_text("utf-8")
    ]
    assert needing == []


#: Names for anything; where a thing has a name, a reader wants that.
VAGUE = {"found", "one", "left", "rest", "turn", "lay", "stands", "beside", "twice", "mine"}
#: The same where the mathematics is: there each stood for three things or more.
VAGUE_IN_MATHEMATICS = set(
    ["own", "at", "known", "late", "about", "what", "alike", "again", "instead", "with_it", "of_all", "of_rest"]
)
MATHEMATICS = ("agent/diagnosis", "agent/experiment", "agent/model")


def test_locals_are_called_what_they_are():
    """`left` is fine with `right`. Names in a class and arguments of public functions are not local."""
    vague = []
    for package in PACKAGES:
        for path in _modules(package):
            where, code = path.relative_to(ROOT).as_posix(), compile(path.read_text("utf-8"), path, "exec")
            forbidden = VAGUE | (VAGUE_IN_MATHEMATICS if where.startswith(MATHEMATICS) else set())
            for scope in ast.walk(_tree(path)) if forbidden & _bound(code) else ():
                if isinstance(scope, ast.Module | ast.Lambda | ast.FunctionDef | ast.AsyncFunctionDef):
                    names = dict(_locals(scope))
                    names.pop("left" if "right" in names else "", None)
                    vague += [f"{where}:{line}: {name}" for name, line in names.items() if name in forbidden]
    assert vague == []


def _bound(code: CodeType) -> set[str]:
    """Names that a module binds in any scope, and some that it only reads; this is quick."""
    inner = (const for const in code.co_consts if isinstance(const, CodeType))
    return {*code.co_names, *code.co_varnames, *code.co_cellvars}.union(*map(_bound, inner))


def _locals(scope: ast.AST) -> Iterator[tuple[str, int]]:
    """Names that a scope binds, with a line of each; those of scopes in it are theirs."""
    for node in ast.iter_child_nodes(scope):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.MatchAs | ast.FunctionDef) and node.name:
            yield node.name, node.lineno
        public = isinstance(node, ast.arguments) and not getattr(scope, "name", "_").startswith("_")
        if not public and not isinstance(node, ast.Lambda | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield from _locals(node)
