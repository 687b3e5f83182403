"""Pages, messages, docstrings and comments use plain terms; pages also have short sentences and few words."""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT

GUIDES = [ROOT / f"{name}.md" for name in ("CODE_OF_CONDUCT", "CONTRIBUTING", "SECURITY")]
PAGES = [ROOT / "README.md", *GUIDES, *sorted((ROOT / "docs").rglob("*.md"))]
#: Generated from code, whose tests check its words.
PENDING = {"docs/reference.md", "docs/measured/numbers.md"}
PACKAGES = ("agent", "benchmarks", "docs", "drivers", "fake_controller", "second_world", "tests")
#: Modules whose texts people read on terminal and pages.
MODULES = {path for package in ("cli", "pipeline", "pages") for path in (ROOT / "agent" / package).rglob("*.py")}
LONGEST, MEAN, LONGEST_SHOWN = 35, 18, 25  # words of a sentence: of a page; of a text of the program
#: Term, and what the field says.
GLOSSARY = {
    r"(?<!\bin )\bplaces?\b(?! on the path| of the path)": "hypothesis, joint, position",
    r"(?<!in the )\bbackground\b": "noise model",
    r"\bgiven model\b|\bmodel that is given\b": "external reference",
    r"(?<!shop )(?<!shaking )\bfloor\b(?!\()": "repeatability",
    r"\bclosure\b": "gap explained",
    r"\bnameable\b": "admissible",
    r"\btold from\b|\btells? \w+ from\b": "distinguished from",
    r"\bbeside\b": "in addition to, alongside, next to",
    r"\bstanding\b|\bat rest\b": "stationary",
    r"\bway gone\b": "distance travelled",
    r"\blet be\b": "ignored, tolerated",
    r"\bso many\b|\bso much\b|\bso long\b": "a count, an amount, a duration",
    r"\bMind:|\bnought\b|\bnone was\b": "what happened and what to do",
    r"\brooms?\b|\bhouse\b": "package, module, layer",
}
TERMS = re.compile("|".join(GLOSSARY))


def _prose(page: Path) -> str:
    """A page without code."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.M)
    text = re.sub(r"^    \S.*$", "", re.sub(r"`[^`\n]*`", "Code", text), flags=re.M)
    return re.sub(r"\]\([^)]*\)", "]", text)


def _words(text: str) -> int:
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def _sentences(page: Path) -> tuple[list[int], list[int]]:
    """Words of each sentence: of paragraphs and lists, and of cells of tables."""
    blocks, cells = [""], []
    for line in _prose(page).splitlines():
        if line.startswith("|"):
            cells += line.strip("| ").split(" | ")
        elif not line.strip() or line.startswith("#"):
            blocks.append("")
        elif re.match(r"\s*([-*]|\d+\.) ", line):
            blocks.append(re.sub(r"^\s*([-*]|\d+\.) ", "", line))
        else:
            blocks[-1] += " " + line
    end = r"(?<=[.!?])\s+(?=[\W_]*[A-Z0-9])"
    counted = [[_words(part) for text in texts for part in re.split(end, text)] for texts in (blocks, cells)]
    return [n for n in counted[0] if n], [n for n in counted[1] if n]


@pytest.fixture(
    params=[page for page in PAGES if page.relative_to(ROOT).as_posix() not in PENDING], ids=lambda page: page.stem
)
def page(request) -> Path:
    return request.param


def test_terms_are_those_of_the_field(page: Path):
    text = _prose(page)
    found = [f"{hit.group()!r}: {better}" for term, better in GLOSSARY.items() for hit in re.finditer(term, text)]
    assert found == []


def test_sentences_are_short(page: Path):
    prose, cells = _sentences(page)
    assert [words for words in (*prose, *cells) if words > LONGEST] == []
    assert sum(prose) <= MEAN * len(prose)


def _texts(module: Path) -> Iterator[str]:
    """Texts of more than a word without markup, a value of an f-string as one word; docstrings apart."""
    nodes = list(ast.walk(ast.parse(module.read_text(encoding="utf-8"))))
    apart = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    apart |= {id(value) for node in nodes if isinstance(node, ast.JoinedStr) for value in node.values}
    for node in nodes:
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        if id(node) not in apart and all(isinstance(part, ast.Constant | ast.FormattedValue) for part in parts):
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in parts)
            if " " in text.strip() and "<" not in text:
                yield text


@pytest.mark.parametrize("module", sorted(MODULES), ids=lambda module: f"{module.parent.name}/{module.stem}")
def test_texts_of_the_program_are_plain_and_short(module: Path):
    texts = list(_texts(module))
    assert [(text, term) for text in texts for term in GLOSSARY if re.search(term, text)] == []
    sentences = [part for text in texts for part in re.split(r"(?<=[.!?;:])\s+", text)]
    assert [part for part in sentences if _words(part) > LONGEST_SHOWN] == []


def _blocks(node: ast.AST) -> Iterator[ast.AST]:
    """A node and the statements below it; no expression holds a docstring, and most nodes are of expressions."""
    yield node
    for part in ("body", "orelse", "handlers", "finalbody", "cases"):
        below = getattr(node, part, ())
        for statement in below if isinstance(below, list) else ():
            yield from _blocks(statement)


def _remarks(module: Path) -> Iterator[str]:
    """Docstrings, comments and names of tests of a module, without names of code in backticks."""
    source = module.read_text(encoding="utf-8")
    for node in _blocks(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield re.sub(r"`[^`]*`", "", ast.get_docstring(node, clean=False) or "")
            name = getattr(node, "name", "")
            if name.startswith("test_"):
                yield name.replace("_", " ")
    if any(TERMS.search(line.partition("#")[2]) for line in source.splitlines()):  # tokens take long
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                yield re.sub(r"`[^`]*`", "", token.string)


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_comments_and_names_of_tests_use_the_terms_of_the_field(package: str):
    texts = ((path, text) for path in sorted((ROOT / package).rglob("*.py")) for text in _remarks(path))
    found = [(path.relative_to(ROOT), text) for path, text in texts if TERMS.search(text)]
    assert found == []


def test_words_are_spelt_right():
    text = "\n".join(_prose(page) for page in PAGES)
    run = subprocess.run(
        [sys.executable, "-m", "codespell_lib", "-"], input=text, capture_output=True, text=True, check=False
    )
    assert (run.returncode, run.stdout) == (0, "")


def test_the_readme_fits_on_two_screens():
    assert len(PAGES[0].read_text(encoding="utf-8").splitlines()) <= 90
