"""The command line as a user meets it: help, refusals, exit codes."""

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core.console import Console, print_path, print_text
from agent.core.output import patient
from agent.excitation import check_sub_region
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import load_recipe
from tests.conftest import ROOT
from tests.recording.conftest import write_foreign


def test_help_loads_nothing_heavy():
    script = (
        "import sys; sys.argv = ['agent', '--help']\n"
        "from agent.cli import main\n"
        "try: main()\nexcept SystemExit as end: assert not end.code\n"
        "heavy = {'numpy', 'scipy', 'pinocchio', 'matplotlib', 'numba', 'pydantic', 'mcap', 'lark'}\n"
        "heavy &= set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "calibrate" in run.stdout


def _help(*words: str) -> str:
    shown = CliRunner().invoke(app, [*words], env={"COLUMNS": "80"})
    assert shown.exit_code == 0
    return shown.output


def test_the_help_shows_groups_and_whole_sentences():
    text = _help("--help")
    places = [text.index(f"─ {group} ─") for group in ("Calibrate", "Diagnose", "Data and models", "Tools", "Fleet")]
    assert places == sorted(places)
    assert "..." not in text.replace("ARGS]...", "")
    assert "─ Commands ─" not in text, "a command without a group"


@pytest.mark.parametrize("group", [(), ("fleet",)])
def test_each_command_shows_an_example(group: tuple[str, ...]):
    """The emulator is a program of its own."""
    commands = re.findall(r"^│ ([a-z][a-z-]+) ", _help(*group, "--help"), re.M)
    for name in set(commands) - {"emulator", "fleet"}:
        assert f"Example: {' '.join(('agent', *group, name))} " in _help(*group, name, "--help")


def test_the_help_of_diagnose_fits_on_one_screen_and_help_all_shows_the_rest():
    first, all_of_it = (
        set(re.findall(r"^│ (--[a-z-]+)", _help("diagnose", how), re.M)) for how in ("-h", "--help-all")
    )
    assert len(first) <= 12
    assert first < all_of_it
    assert {"--cutoff", "--planning-budget", "--allow-mixed"} <= all_of_it - first


def test_reports_a_signal_received_in_compiled_code_as_a_signal():
    """Python says SystemError where a handler raises while a function in C returns a result."""
    script = (
        "from agent.cli import entry_point as entry\n"
        "def hit(standalone_mode):\n"
        "    raise SystemError('returned a result with an exception set') from KeyboardInterrupt()\n"
        "entry.app = hit\n"
        "entry.main()\n"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 130
    assert run.stderr == "agent: interrupted\n"


@pytest.mark.parametrize(("number", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
def test_a_signal_while_the_command_line_is_loaded_ends_it_with_one_line(number: int, word: str):
    script = (
        "import os, runpy, sys\n"
        "class Struck:\n"
        "    def find_spec(name, path, target=None):\n"
        f"        if name == 'typer': os.kill(os.getpid(), {number:d})\n"
        "sys.meta_path.insert(0, Struck)\n"
        "sys.argv = ['agent', '--version']\n"
        "runpy.run_module('agent', run_name='__main__', alter_sys=True)\n"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (128 + number, "", f"agent: {word}\n")


@pytest.mark.parametrize("command", ["--help", "--version", "diagnose --help-all", "schedule recipes/first_look.yaml"])
def test_a_reader_that_is_gone_is_no_error(command: str):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as pipe:
        words = [sys.executable, "-u", "-m", "agent", *command.split()]
        run = subprocess.run(words, cwd=ROOT, stdout=pipe, stderr=subprocess.PIPE, check=False)
    assert (run.returncode, b"Traceback" in run.stderr) == (0, False), run.stderr


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("calibrat", "calibrat"),
        ("blind-check --cases 3 -o out --seed -1", "'--seed': Input should be greater than or equal to 0"),
        ("fleet simulate -n 1 -o out --seed -1", "'--seed': Input should be greater than or equal to 0"),
        ("record recipe.yaml --program .", "agent: .: is a folder; name the program to run with --program\n"),
        ("init nowhere/mine.yaml", "no folder nowhere"),
        ("check list.yaml", "list.yaml:1: a mapping of keys is expected, not a list"),
        ("import --robot comau_ns16 --map map.yaml table.csv log.mcap", "log.mcap: exists already"),
        ("import --robot comau_ns16 --map map.yaml table.csv nowhere/log.mcap", "no folder nowhere"),
    ],
)
def test_a_mistake_is_one_message_and_writes_nothing(write_recipe, run_agent, tmp_path: Path, command: str, said: str):
    write_recipe("127.0.0.1:1")
    files = {"list.yaml": "- robot: comau_ns16\n", "map.yaml": "rate: 500 Hz\n", "table.csv": "t\n0\n", "log.mcap": "x"}
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    run = run_agent(*command.split())
    assert run.returncode == 2
    assert said in run.stdout + run.stderr
    assert "Traceback" not in run.stderr
    assert {path.name for path in tmp_path.iterdir()} == {*files, "recipe.yaml"}
    assert (tmp_path / "log.mcap").read_text(encoding="utf-8") == "x"


@pytest.mark.parametrize(("streams", "code", "said"), [("<&- >&-", 0, "next: "), (">/dev/full", 1, "; free space")])
def test_a_stream_that_is_closed_or_full_is_no_internal_error(tmp_path: Path, streams: str, code: int, said: str):
    command = f"{sys.executable} -m agent init {tmp_path}/mine.yaml --robot comau_ns16 {streams}"
    run = subprocess.run(command, shell=True, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert (run.returncode, said in run.stderr, "Traceback" in run.stderr) == (code, True, False), run.stderr


def test_a_recipe_from_init_passes_the_offline_part_of_check(run_agent, tmp_path: Path):
    assert run_agent("init", "mine.yaml").returncode == 0
    again = run_agent("init", "mine.yaml")
    assert again.returncode == 2
    assert "exists already" in again.stderr
    text = (tmp_path / "mine.yaml").read_text(encoding="utf-8").replace("127.0.0.1:9100", "127.0.0.1:1")
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    run = run_agent("check", "mine.yaml", "--json")
    findings = {entry["subject"]: entry for entry in json.loads(run.stdout)["findings"]}
    assert run.returncode == 4
    assert "random loops at 1 m/s tried" in run.stderr
    assert "checking controller" in run.stderr
    assert [name for name, entry in findings.items() if not entry["ok"]] == ["controller"]
    assert "no controller answers at 127.0.0.1:1" in findings["controller"]["message"]


def test_check_tells_all_problems_at_once(write_recipe, run_agent):
    path = write_recipe("127.0.0.1:1")
    path.write_text(path.read_text(encoding="utf-8").replace("[1.0 m, 0 m, 0.8 m]", "[2.4 m, 0 m, 0.8 m]"))
    run = run_agent("check", path)
    assert run.returncode == 2
    problems = [line for line in run.stdout.splitlines() if line.startswith("PROBLEM")]
    assert any("sub-region" in line and "out of reach" in line for line in problems)
    assert any("controller" in line for line in problems)


def test_recipe_faults_name_line_and_key(write_recipe, run_agent, tmp_path):
    path = write_recipe("127.0.0.1:1", speed="0.2 kg")
    text = path.read_text(encoding="utf-8").replace("population", "populaton")
    path.write_text(text, encoding="utf-8")
    run = run_agent("calibrate", path)
    assert run.returncode == 2
    line = {
        key: number for number, row in enumerate(text.splitlines(), 1) for key in ("populaton", "0.2 kg") if key in row
    }
    assert f"recipe.yaml:{line['populaton']}: search.populaton: unknown key" in run.stderr
    assert f"recipe.yaml:{line['0.2 kg']}: validate.speed" in run.stderr
    assert not (tmp_path / "logs").exists()


def test_an_unreachable_controller_exits_with_4_and_names_the_step(only_run, write_recipe, run_agent, tmp_path: Path):
    path = write_recipe("127.0.0.1:1", motions=1)
    run = run_agent("calibrate", path)
    assert run.returncode == 4
    assert "no controller answers at 127.0.0.1:1" in run.stderr
    folder = only_run(tmp_path / "logs")
    state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    assert (state["status"], state["stopped"]["step"]) == ("stopped", "plan")
    assert "search" not in run.stderr, "the controller is asked before the search"
    assert f"agent calibrate recipe.yaml --resume {folder.name}" in run.stderr


def test_prints_the_version(run_agent):
    run = run_agent("--version")
    assert run.returncode == 0
    assert re.fullmatch(r"[0-9]+(\.[0-9]+)+\S*\n", run.stdout)


def test_the_shell_completes_commands():
    program = Path(sys.executable).with_name("agent")
    words = {"_AGENT_COMPLETE": "complete_bash", "COMP_WORDS": "agent recal", "COMP_CWORD": "1"}
    run = subprocess.run([program], env={**os.environ, **words}, capture_output=True, text=True, check=False)
    assert run.stdout.split() == ["recalibrate"], run.stderr


def test_progress_on_a_terminal_stays_below_messages_and_is_erased(monkeypatch):
    here, there = pty.openpty()
    with open(there, "w", encoding="utf-8") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "60")
        now = [0.0]
        console = Console(clock=lambda: now[0])
        shown = []
        for call in (
            lambda: console.step("search"),
            lambda: console.progress("generation 1 of 4: " + "and so on " * 5, 0.25),
            lambda: console.progress("too early for another picture"),
            lambda: console.warn("[beware]"),
            lambda: print_text("found"),
        ):
            call()
            assert patient(terminal).drain()
            read = b""
            while select.select([here], [], [], 0)[0]:
                read += os.read(here, 10_000)
            shown.append(read.decode())
            now[0] += 0.06
    os.close(here)
    search, picture, nothing, warning, end = shown
    assert search == "[   0.0 s] search\r\n"
    assert "generation 1 of 4" in picture
    assert "━" in picture
    assert max(map(len, re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", picture).split("\r"))) <= 61  # wrapped, not cut
    assert nothing == ""
    assert warning.index("[beware]") < warning.index("generation 1 of 4")
    assert "\x1b[?25h" in end  # the cursor is back
    assert end.endswith("\x1b[2K")  # on an empty line


def test_progress_tells_the_time_left_and_paths_are_links_on_a_terminal(monkeypatch, capsys, tmp_path: Path):
    now = [0.0]
    console = Console(clock=lambda: now[0])
    console.step("search")
    now[0] = 10.0
    console.progress("generation 1 of 4", 0.25)
    assert "generation 1 of 4, about 30 s left" in capsys.readouterr().err
    print_path(tmp_path)
    assert capsys.readouterr().out == f"{tmp_path}\n"
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    print_path(tmp_path)
    assert capsys.readouterr().out == f"\033]8;;{tmp_path.as_uri()}\033\\{tmp_path}\033]8;;\033\\\n"


def test_an_import_takes_a_map_or_a_preset(run_agent, tmp_path: Path):
    rows = "".join(f"{k / 500},{','.join(6 * [f'{k / 1e3}'])}\n" for k in range(200))
    names = ",".join(["timestamp", *(f"actual_q_{k}" for k in range(6))])
    (tmp_path / "rec.csv").write_text(f"{names}\n{rows}")
    words = ("import", "--robot", ROOT / "recipes/examples/ur10/ur10.urdf", tmp_path / "rec.csv", tmp_path / "o.mcap")
    for wrong in ((), ("--preset", "ur-rtde", "--map", "map.yaml")):
        run = run_agent(*words, *wrong)
        assert run.returncode == 2
        assert "either --map MAP.yaml or --preset NAME" in run.stderr
    for path, what in ((tmp_path / "absent.csv", "no such file"), (tmp_path, "meta/info.json")):
        run = run_agent(*words[:3], path, tmp_path / "o.mcap")
        assert run.returncode == 2
        assert what in run.stderr
    run = run_agent(*words, "--preset", "ur-rtde")
    assert run.returncode == 0, run.stderr
    assert "200 samples, 0.398 s at 500 Hz" in run.stderr


def test_a_topic_is_named_on_the_command_line(run_agent, tmp_path: Path):
    names = [f"joint_{k}" for k in range(1, 7)]
    both = [
        {"topic": topic, "time": k / 100, "names": names, "position": [k / 1e3] * 6, "effort": [1.0] * 6}
        for k in range(50)
        for topic in ("/a/joint_states", "/b/joint_states")
    ]
    log = write_foreign(tmp_path / "log.mcap", both)
    for words in (("estimate", "-o", tmp_path / "m.json"), ("diagnose",)):
        run = run_agent(words[0], "--robot", "comau_ns16", *words[1:], log)
        assert run.returncode == 2
        assert "/a/joint_states (joint_1" in run.stderr
        assert "--topic" in run.stderr
        run = run_agent(words[0], "--robot", "comau_ns16", *words[1:], "--topic", "/c", log)
        assert "no joint states on the topic /c" in run.stderr


def test_a_new_recipe_has_its_sub_region_within_reach(run_agent, tmp_path: Path):
    """Of a small arm as of the built-in one: `agent check` finds nothing out of reach."""
    for robot in ("comau_ns16", str(ROOT / "recipes/examples/tx40/robot.yaml")):
        name = f"{Path(robot).parent.name}.yaml"
        assert run_agent("init", name, "--robot", robot).returncode == 0
        recipe = load_recipe(tmp_path / name)
        assert not check_sub_region(loop_problem(recipe, recipe.motion.speed))
