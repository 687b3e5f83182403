"""Writes docs/gallery.md and its pictures in docs/gallery: models identified from public logs, and the quickstart.

`python docs/make_gallery.py` reads the logs from ../shared/data (docs/real-data.md names their sources); without them
it writes nothing. It takes some minutes.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import textwrap
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from make_picture import HOSE, screen_of

import agent as ca
from agent.notebook import Model, TorqueValidation
from agent.pages import Plot, friction_section, headline, still, torque_plot
from agent.recording import import_log
from agent.robot import torque_units
from agent.validation import pooled_rmse, summary

DOCS = Path(__file__).resolve().parent
DATA = DOCS.parents[1] / "shared/data"
LEGEND, SCALE = 16, 1.5  # units above a panel of a picture; pixels per unit
PAGE, PICTURES = DOCS / "gallery.md", DOCS / "gallery"
TX40 = DOCS.parent / "recipes/examples/tx40"
TABLES = [DATA / "tx40/pos_read_data.csv", DATA / "tx40/curr_data.csv"]
SIMULATED, RECIPE = "NS16", "ns16_quickstart.yaml"
SHOWN, LARGE = 10.0, 0.2  # s of motion in a picture; error over RMS torque that the page points out
INTRODUCTION = """# Gallery

What you get from the agent, before you try it. Each model is identified with default settings except for the cut-off
frequency, and predicts the torque of motion that it was not fitted to. `agent diagnose` then looks for what the model
lacks. "No gap" rules out only the effects that the logs could show; each section says how many.

Pictures show the joint with the largest error first. In those of friction, the line and its 95 % band are the model
without load-dependent terms; dots are measured torque minus the torque of the links.

The public logs are not in this repository; [Public logs](real-data.md) names their sources. `python
docs/make_gallery.py` wrote this page and its pictures on {date} at commit {commit}.

| arm | licence of the logs | torque error on held-out motion | diagnosis |
| --- | --- | --- | --- |"""


DEV = DATA / "real-dev"
SERVO = ("kp400_sin_sin kp400_up_and_down", "kp200_sin_time_square kp200_lift_and_drop")
#: By the name of their row in docs/real-data.md: arm, description, logs to fit and held out, cut-off [Hz].
ARMS = {
    "TX40": ("Stäubli TX40, six axes", TX40 / "robot.yaml", "fit", "held_out", 20.0),
    "KR300": ("KUKA KR300; nominal torques are assumed", DEV / "kr300/robot_real.yaml", "A B", "C", 10.0),
    "TIAGo": ("PAL TIAGo, a slide (N, m/s) and six axes", DEV / "tiago/robot.yaml", "fit", "held", 10.0),
    "XL330": ("Dynamixel XL330, a servo with a pendulum", DEV / "bam_xl330/robot.yaml", *SERVO, 10.0),
}
WITH_MODEL = "What `agent diagnose` says about the held-out logs with this model:"
UNCOUPLED = (
    "The held-out part is too short for a diagnosis of its own. So `agent diagnose` gets both parts, no model, and a "
    "description without the coupling of the wrist. It says:"
)
RECORDED = "A hose was added to joint 4. {} What `agent diagnose --record` says with this model:"


def main() -> None:
    """Write the page and its pictures."""
    missing = [path for path in (*TABLES, *(description for _, description, *_ in ARMS.values())) if not path.exists()]
    if missing:
        print(f"skipped: {missing[0]} is missing; docs/real-data.md names the sources of the logs", file=sys.stderr)
        return
    command = ["git", "rev-parse", "--short=12", "HEAD"]
    commit = subprocess.run(command, cwd=DOCS, check=True, capture_output=True, text=True).stdout.strip()
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        made = [public(name, Path(folder)) for name in ARMS] + [simulated(Path(folder))]
    introduction = INTRODUCTION.format(date=f"{datetime.now(UTC):%Y-%m-%d}", commit=commit)
    PAGE.write_text("\n".join([introduction, *(row for row, _ in made), *(text for _, text in made)]) + "\n", "utf-8")


def source_of(name: str) -> tuple[str, str]:
    """Repository with its commit, and licence, as docs/real-data.md has them."""
    rows = [line.strip("| ").split(" | ") for line in (DOCS / "real-data.md").read_text("utf-8").splitlines()]
    repository, commit, licence = next(row[1:4] for row in rows if name in row[0].split(", "))
    at = "commit not recorded" if commit == "–" else f"commit {commit}"
    return f"[{repository}](https://github.com/{repository}), {at}", licence


def public(name: str, folder: Path) -> tuple[str, str]:
    """Row of the table and section of public logs."""
    (what, description, *parts, cutoff), (source, licence) = ARMS[name], source_of(name)
    robot, where = ca.load_robot(description), description.parent
    if name == "TX40":
        where = folder
        for part in parts:
            import_log(robot, TX40 / f"map_{part}.yaml", TABLES, folder / f"{part}.mcap")
    fitted, held_out = ([where / f"{log}.mcap" for log in logs.split()] for logs in parts)
    model = ca.estimate(robot, fitted, cutoff=cutoff)
    if name == "TX40":
        uncoupled = replace(robot, motor_coupling=tuple(map(tuple, np.eye(robot.dof).tolist())))
        case, how = "Coupling of the wrist left out: ", UNCOUPLED
        found = ca.diagnose(uncoupled, [*fitted, *held_out], cutoff=cutoff)
    else:
        case, how, found = "", WITH_MODEL, ca.diagnose(robot, held_out, model)
    said = [found.text().partition("\n\n")[0], *(f"warning: {text}" for text in found.diagnosis.warnings)]
    about = [f"Robot: {what}.", f"Source: {source}. Licence: {licence}."]
    about.append(f"Fitted: `{parts[0]}`. Held out: `{parts[1]}`. Cut-off: {cutoff:g} Hz.")
    return _entry(name, licence, about, ca.validate(model, held_out), case + headline(found.to_dict()), how, said)


def simulated(folder: Path) -> tuple[str, str]:
    """The same of the quickstart on the fake controller; the diagnosis is of a robot with a hose on joint 4."""
    screen = screen_of(folder, RECIPE).partition("\n\n")[0].splitlines()[1:]
    calibration, diagnosis = sorted((folder / "logs").glob("*_comau_ns16"))
    validation = ca.validate(calibration / "model.json", str(calibration / "validation_*.mcap"))
    result = json.loads((diagnosis / "result.json").read_text("utf-8"))
    about = ["Robot: COMAU NS16. **Simulated**: no real arm moved.", f"Source: `recipes/{RECIPE}`, fake controller."]
    about.append(f"Fitted: the planned loop. Held out: {len(validation.predictions)} slow motions.")
    found = f"Hose added to joint 4: {headline(result)}"
    said = [line for line in screen if "logs/" not in line]  # less a command with the paths of this run
    return _entry(SIMULATED, "simulated", about, validation, found, RECORDED.format(_hose_found(result)), said)


def _hose_found(result: dict[str, Any]) -> str:
    """How what was found compares with what was added."""
    named = [[cause["effect"], *(other["effect"] for other in cause["equivalent_to"])] for cause in result["causes"]]
    right = next((names for names in named if HOSE["effect"] in names), [])
    how = "is not found" if not right else "is one of several that fit" if len(right) > 1 else "is named"
    wrong = ", ".join(f"`{names[0]}`" for names in named if names != right)
    return f"The hose (`{HOSE['effect']}`) {how}.{f' Named, but not added as such: {wrong}.' if wrong else ''}"


def _entry(
    name: str, licence: str, about: list[str], validation: TorqueValidation, found: str, how: str, said: list[str]
) -> tuple[str, str]:
    errors, first = summary(validation.predictions).overall, validation.predictions[0]
    robot = first.model.robot
    columns = (robot.joint_names, errors.rmse, torque_units(robot), errors.relative_error, errors.normalised_rmse)
    rows = list(zip(*columns, strict=True))
    large = [joint for joint, _, _, share, _ in rows if share > LARGE]
    error = f"{100 * errors.relative_error_all_joints:.1f} %"
    error += " (poor)" if errors.relative_error_all_joints > LARGE else ""
    error += f"; above {100 * LARGE:g} % on {', '.join(large)}" if large else ""
    lines = [f"\n## {name}\n", *(f"- {text}" for text in about)]
    lines.append(f"- Model: {Model.of(first.model).headline().partition(';')[0]}.\n")
    lines.append("| joint | held-out RMSE | over RMS torque | over nominal torque |\n| --- | --- | --- | --- |")
    for joint, rmse, unit, *shares in rows:
        cells = " | ".join("–" if share is None else f"{100 * share:.1f} %" for share in shares)
        lines.append(f"| {joint} | {rmse:.3g} {unit} | {cells} |")
    torque = torque_plot(first, pooled_rmse(validation.predictions), first.time[0], first.time[0] + SHOWN)
    torque = replace(torque, caption=f"measured and predicted torque, {first.log}")
    panels = [replace(p, series=[one for one in p.series if one.look != "part"]) for p in torque.panels[::2]]
    pictures = [replace(torque, panels=panels), friction_section(validation.predictions).parts[0]]
    lines += ["", *(f"{_picture(name, plot)}\n" for plot in pictures), f"{how}\n\n```text"]
    for line in "\n".join(said).splitlines():
        lines += textwrap.wrap(line, 100, subsequent_indent=" " * 10)
    return f"| [{name}](#{name.lower()}) | {licence} | {error} | {found} |", "\n".join([*lines, "```"])


def _picture(name: str, plot: Plot) -> str:
    """Write the panels of a plot as one picture on white, which reads on a dark page too; the link to it."""
    path = PICTURES / f"{name.lower()}_{plot.name}.svg"
    panels = re.findall(r"<p>(.*?)</p><svg([^>]*)>(.*?)</svg>", still(plot), flags=re.S)
    wide, high = (int(size) for size in re.findall(r'viewBox="0 0 (\d+) (\d+)"', panels[0][1])[0])
    columns = min(plot.columns, len(panels))
    cells = []
    for number, (legend, head, content) in enumerate(panels):
        x, y = number % columns * wide, number // columns * (high + LEGEND)
        words = re.sub(r'<span style="color:(.*?)">(.*?)</span>', r'<tspan fill="\1">\2</tspan>', legend)
        words = words.replace("<b>", '<tspan font-weight="bold">').replace("</b>", "</tspan>")
        cells.append(f'<text x="{x + 30}" y="{y + 11}" font-size="10" font-family="sans-serif">{words}</text>')
        cells.append(f'<svg x="{x}" y="{y + LEGEND}" width="{wide}" height="{high}"{head}>{content}</svg>')
    width, height = columns * wide, -(-len(panels) // columns) * (high + LEGEND)
    size = f'width="{width * SCALE:.0f}" height="{height * SCALE:.0f}" viewBox="0 0 {width} {height}"'
    body = "\n".join(['<rect width="100%" height="100%" fill="#fff"/>', *cells])
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{body}</svg>\n', encoding="utf-8")
    return f"![{name}, {plot.caption.rstrip('.')}](gallery/{path.name})"


if __name__ == "__main__":
    main()
