"""From files to a diagnosis, and what it says to people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.console import Console
from agent.identify import read_logs
from agent.robot import load_robot

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis

_VERDICTS = {
    "no_gap": "no gap: nothing of practical size beyond what the model's own prediction error allows",
    "explained": "explained",
    "ambiguous": "ambiguous: the data cannot tell the first cause from its equivalents",
    "unknown": "unknown: there is a gap, and no effect of the catalogue closes it",
}


def diagnose_files(
    robot: str,
    model: Path | None,
    paths: Sequence[Path],
    cutoff: float | None,
    without: Sequence[str],
    report: Path | None,
    console: Console,
) -> Diagnosis:
    """Diagnose logs; writes the report where one is asked for.

    Raises:
        InputError: a robot, model or log that cannot be used, or an unknown effect.
    """
    from agent.diagnosis import diagnose
    from agent.estimation import IdentifiedModel

    description = load_robot(robot)
    reference = None if model is None else IdentifiedModel.load(model)
    logs = read_logs(list(paths), description, console)
    found = diagnose(description, logs, reference, cutoff, without)
    for warning in found.warnings:
        console.warn(warning)
    if report is not None:
        from agent.diagnosis.report import diagnosis_report
        from agent.run import write_atomically

        write_atomically(report, diagnosis_report(found))
    return found


def diagnosis_text(result: dict[str, Any]) -> str:
    """A diagnosis for people."""
    lines = [_VERDICTS[result["verdict"]]]
    for cause in result["causes"]:
        joints = ", ".join(cause["joints"]) or "the whole arm"
        closure = "" if cause["closure"] is None else f", closes {100 * cause['closure']:.0f} % of the gap"
        lines.append(f"  {cause['effect']} on {joints}{closure}, probability {cause['probability']:.2f}")
        parameters = "  ".join(f"{name} {value:.4g}" for name, value in cause["parameters"].items())
        lines.append(f"    {parameters}")
        for other in cause["equivalent_to"]:
            lines.append(f"    as good: {other['effect']} on {', '.join(other['joints']) or 'the whole arm'}")
    gap = result["gap"]
    lines.append(f"{'joint':12} {'before':>9} {'after':>9} {'floor':>9} {'share':>7}   mostly in")
    shares = {entry["joint"]: entry for entry in result["where"]}
    for k, name in enumerate(gap["joints"]):
        floor = "-" if gap["floor"] is None else f"{gap['floor'][k]:.4f}"
        regimes = [r["name"] for r in shares[name]["regimes"] if r["share"] > 1.5 * r["of_samples"]][:2]
        lines.append(
            f"{name:12} {gap['before'][k]:9.4f} {gap['after'][k]:9.4f} {floor:>9} {100 * shares[name]['share']:6.1f}%"
            f"   {', '.join(regimes)}"
        )
    if result["closure"] is not None:
        lines.append(f"closure {result['closure']:.3f}")
    if result["next_experiment"] is not None:
        lines.append(f"run next: {result['next_experiment']['motion']}")
    if result["not_testable"]:
        names = sorted({entry["effect"] for entry in result["not_testable"]})
        lines.append(f"not testable on some joints here: {', '.join(names)}")
    return "\n".join(lines)
