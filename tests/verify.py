"""`make verify`: run the long figures piece by piece and write docs/measured/measured.md.

Each test function marked `verify` is a piece, with all of its parameters. A finished piece is kept in `.verify/` with
its commit, so an interrupted run continues where it stopped. `--fresh` starts again, `--keep` also keeps what passed on
earlier commits. `tests/verify.py FOLDER…` runs the pieces of these folders or files alone; the others are listed as
they were, or as not run. `docs/measured/figures.csv` and `docs/measured/pieces.csv` hold all figures and outcomes.
"""

import argparse
import csv
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STATE = ROOT / ".verify"
MEASURED = ROOT / "docs/measured"
LONGEST = 4 * 3600  # s for one test, after which it counts as hung


def main() -> int:
    """0 if every piece that was run passed."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--fresh", action="store_true", help="forget every piece that is finished")
    arguments.add_argument("--keep", action="store_true", help="keep what passed on earlier commits")
    arguments.add_argument("only", nargs="*", help="folders or files of tests; all without any")
    chosen = arguments.parse_args()
    STATE.mkdir(exist_ok=True)
    commit = _commit()
    if chosen.fresh:
        for old in STATE.glob("*.json*"):
            old.unlink()
    nodes = _collect([])
    wanted = set(_collect(chosen.only)) if chosen.only else set(nodes)
    print(f"{len(wanted)} of {len(nodes)} pieces", flush=True)
    results = {node: kept for node in nodes if (kept := _kept(node)) is not None}
    failed = False
    for node in nodes:
        if node not in wanted:
            continue
        known = results.get(node)
        if known is None or not (known["commit"] == commit or (chosen.keep and known["outcome"] == "passed")):
            results[node] = _run(node, commit)
        failed |= results[node]["outcome"] == "failed"
        print(f"{results[node]['outcome']:7} {results[node]['seconds']:7.1f} s  {node}", flush=True)
        _write([results.get(each) or _not_run(each) for each in nodes], commit)
    return int(failed)


def _collect(only: list[str]) -> list[str]:
    command = [sys.executable, "-m", "pytest", "--collect-only", "-m", "verify", *only]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    return list(dict.fromkeys(line.partition("[")[0] for line in listing.splitlines() if "::" in line))


def _file(node: str) -> Path:
    return STATE / f"{hashlib.sha256(node.encode()).hexdigest()[:16]}.json"


def _kept(node: str) -> dict | None:
    done = _file(node)
    return json.loads(done.read_text(encoding="utf-8")) if done.exists() else None


def _not_run(node: str) -> dict:
    return {
        "node": node,
        "commit": "",
        "outcome": "not run",
        "seconds": "",
        "at": "",
        "figures": [],
        "summary": "",
        "tail": [],
    }


def _run(node: str, commit: str) -> dict:
    done = _file(node)
    figures = done.with_suffix(".jsonl")
    figures.unlink(missing_ok=True)
    started = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-m", "verify", "--no-header", "-rsf", "--tb=short", node]
    # a file and not a pipe: what a piece leaves running would keep that open
    with tempfile.TemporaryFile("w+") as printed:
        run = subprocess.run(
            [*command, "-o", f"faulthandler_timeout={LONGEST}"],
            cwd=ROOT,
            env={**os.environ, "CALIBRATION_FIGURES": str(figures)},
            stdout=printed,
            stderr=subprocess.STDOUT,
            check=False,
        )
        printed.seek(0)
        output = printed.read()
    outcome = "failed" if run.returncode else "passed" if " passed" in output else "skipped"
    lines = figures.read_text(encoding="utf-8").splitlines() if figures.exists() else []
    result = {
        "node": node,
        "commit": commit,
        "outcome": outcome,
        "seconds": round(time.monotonic() - started, 1),
        "at": datetime.now(UTC).isoformat(timespec="minutes"),
        "figures": [json.loads(line) for line in lines],
        "summary": output.strip().splitlines()[-1].strip("= ") if output.strip() else "",
        "tail": [line for line in output.splitlines() if line.startswith(("SKIPPED", "FAILED", "ERROR"))],
    }
    beside = done.with_suffix(".tmp")
    beside.write_text(json.dumps(result), encoding="utf-8")
    beside.replace(done)
    return result


def _write(results: list[dict], commit: str) -> None:
    figures = [(figure, result) for result in results for figure in result["figures"]]
    short = [_row(*row) for row in figures if not row[0]["ok"]]
    for result in results:
        if result["outcome"] == "failed":
            short += [f"- {line}" for line in result["tail"] or [f"FAILED {result['node']}"]]
        if result["outcome"] == "skipped":
            short.append(f"- skipped: `{result['node']}` ({_reason(result)})")
    head = (
        f"Written by `make verify` at commit {commit[:12]} on {datetime.now(UTC):%Y-%m-%d}: Python "
        f"{platform.python_version()}, {platform.system()} {platform.machine()}, {os.cpu_count()} cores."
    )
    write_page(
        MEASURED,
        head,
        short,
        [(f["what"], _value(f), f["target"], "yes" if f["ok"] else "no") for f, _ in figures],
        [(r["node"], r["summary"] or r["outcome"], r["at"], r["commit"][:7]) for r in results],
    )


def write_page(
    folder: Path, head: str, short: list[str], figures: list[tuple[str, ...]], pieces: list[tuple[str, ...]]
) -> None:
    """Write the page, and the tables that it sums up.

    Parameters
    ----------
    folder
        Where `measured.md`, `figures.csv` and `pieces.csv` go.
    head
        Commit, date and machine.
    short
        Lines of the list of shortfalls.
    figures
        Of each figure: what, measured, target, whether it is met.
    pieces
        Of each piece: test, outcome, when (UTC), commit.
    """
    _table(folder / "figures.csv", ("what", "measured", "target", "met"), figures)
    _table(folder / "pieces.csv", ("piece", "outcome", "when", "commit"), pieces)
    with_target = [figure for figure in figures if figure[2]]
    met = sum(figure[3] == "yes" for figure in with_target)
    lines = ["# Measured", "", head, ""]
    lines += [f"{met} of {len(with_target)} figures with a target meet it. [Figures](figures.csv) lists all of them,"]
    lines += ["[pieces](pieces.csv) each test with its outcome, date and commit.", ""]
    lines += ["## Shortfalls", "", *(short or ["None in what was run."]), ""]
    lines += ["## Pieces by package", "", "| tests | passed | failed | not run |", "| --- | --- | --- | --- |"]
    for package in dict.fromkeys(piece[0].split("/")[1] for piece in pieces):
        of = [piece[1] for piece in pieces if piece[0].split("/")[1] == package]
        failed = sum("failed" in text for text in of)
        passed = sum("passed" in text and "failed" not in text for text in of)
        lines.append(f"| {package} | {passed} | {failed} | {len(of) - passed - failed} |")
    (folder / "measured.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _table(path: Path, head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def _row(figure: dict, result: dict) -> str:
    return f"- {figure['what']}: {_value(figure)}, wanted {figure['target']} (`{result['node']}`)"


def _value(figure: dict) -> str:
    value = figure["value"]
    return (
        f"{value:.4g} {figure['unit']}".strip()
        if isinstance(value, (int, float))
        else f"{value} {figure['unit']}".strip()
    )


def _reason(result: dict) -> str:
    skips = (line.split(": ", 1)[-1] for line in result["tail"] if line.startswith("SKIPPED"))
    return next(skips, "skipped")


def _commit() -> str:
    command = ["git", "rev-parse", "HEAD"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


if __name__ == "__main__":
    sys.exit(main())
