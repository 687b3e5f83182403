"""Tests in several processes: what one of them does not survive is a failure, and the rest runs."""

import subprocess
import sys

from tests.conftest import environment

FILES = {
    "conftest.py": "from tests.forked import pytest_addoption, pytest_runtestloop",
    "test_a.py": "import os\ndef test_ends(): os._exit(3)\ndef test_runs_in_another_process(): pass",
    "test_b.py": "def test_prints(capfd):\n    print(1)\n    assert capfd.readouterr().out == '1\\n'",
    "test_c.py": "import pytest\n@pytest.mark.alone\ndef test_is_last(): pass\ndef test_fails(): assert 1 == 2",
}


def test_a_process_that_ends_fails_its_test_alone(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "--forks", "2", "--rootdir", tmp_path, tmp_path]
    run = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stderr
    assert "ended with exit code 3" in run.stdout
    assert "assert 1 == 2" in run.stdout
    assert "2 failed, 3 passed" in run.stdout
