"""Lines, numbers and words of each part against the last release: `python tests/sizes.py`, printed by CI."""

import ast
import csv
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LAST_RELEASE = ROOT / "docs" / "measured" / "sizes.csv"
PARTS = ("agent/*", "drivers", "fake_controller", "second_world", "benchmarks", "tests", "docs")


def sizes() -> dict[str, tuple[int, int, int]]:
    """Lines of Python, numbers in its code other than -1, 0, 1 and 2, and words of pages, by part."""
    folders = [path for part in PARTS for path in sorted(ROOT.glob(part)) if path.is_dir() and path.name[0] not in "._"]
    return {folder.relative_to(ROOT).as_posix(): _size(folder) for folder in folders}


def _size(folder: Path) -> tuple[int, int, int]:
    modules = [path.read_text("utf-8") for path in folder.rglob("*.py")]
    nodes = (node for text in modules for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant))
    numbers = sum(type(node.value) in (int, float) and abs(node.value) not in (0, 1, 2) for node in nodes)
    words = sum(
        bool(re.search(r"\w", word)) for path in folder.rglob("*.md") for word in path.read_text("utf-8").split()
    )
    return sum(len(text.splitlines()) for text in modules), numbers, words


def main() -> None:
    """Prints the table, or writes it as that of the release with `--release`."""
    now = sizes()
    if "--release" in sys.argv:
        with LAST_RELEASE.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([("part", "lines", "numbers", "words")])
            csv.writer(file, lineterminator="\n").writerows((part, *counts) for part, counts in now.items())
        return
    with LAST_RELEASE.open(encoding="utf-8") as file:
        last = {
            row["part"]: tuple(int(row[name]) for name in ("lines", "numbers", "words")) for row in csv.DictReader(file)
        }
    print(f"{'part':24} {'lines':>14} {'numbers':>14} {'words':>14}   (against the last release)")
    for part, counts in now.items():
        before = last.get(part, (0, 0, 0))
        print(f"{part:24} " + " ".join(f"{n:7} {n - b:+6}" for n, b in zip(counts, before, strict=True)))


if __name__ == "__main__":
    main()
