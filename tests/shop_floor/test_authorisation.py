"""A person's word: what it must say, who may have written it, and what it covers."""

import json
from contextlib import nullcontext
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import assume, given, strategies as st

from agent.core.errors import InputError
from agent.safety.authorisation import Authorisation, AuthorisationDocument, load_authorisation

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
PROGRAM = "ab" * 32
PROBLEM = "cd" * 32
SAID = {
    "robot": "comau_ns16",
    "serial": "NS16-42",
    "program": PROGRAM,
    "problem": PROBLEM,
    "limits": {"speed": "1 m/s", "duration": "20 min"},
    "expires": "2026-12-31",
    "written_by": "M. Rossi",
}


def _write(folder: Path, mode: int = 0o644, **changes: object) -> Path:
    path = folder / "authorisation.yaml"
    path.write_text(json.dumps({k: v for k, v in {**SAID, **changes}.items() if v is not None}), encoding="utf-8")
    path.chmod(mode)
    return path


def test_a_file_is_read_in_si(tmp_path: Path):
    allowed = load_authorisation(_write(tmp_path), NOW)
    word = allowed.document
    assert (word.limits.speed, word.limits.duration, word.expires) == (1.0, 1200.0, date(2026, 12, 31))
    allowed.check("comau_ns16", "NS16-42", PROGRAM, 1.0, 1200.0, NOW)


@pytest.mark.parametrize("key", list(SAID))
def test_refuses_a_missing_key(tmp_path: Path, key: str):
    with pytest.raises(InputError, match=f"{key}: this key is required"):
        load_authorisation(_write(tmp_path, **{key: None}), NOW)


def test_refuses_a_file_that_others_can_write(tmp_path: Path):
    for mode in (0o664, 0o646, 0o666, 0o620, 0o602, 0o622, 0o660, 0o606, 0o676, 0o777):
        with pytest.raises(InputError, match="chmod go-w"):
            load_authorisation(_write(tmp_path, mode), NOW)


def test_an_authorisation_is_bound_to_the_planning_problem(tmp_path: Path):
    allowed = load_authorisation(_write(tmp_path), NOW)
    allowed.check_problem(PROBLEM)
    with pytest.raises(InputError, match=f"problem cdcdcdcdcdcd.*make {'ef' * 32}"):
        allowed.check_problem("ef" * 32)


def test_refuses_an_expiry_more_than_a_year_ahead(tmp_path: Path):
    with pytest.raises(InputError, match="more than a year"):
        load_authorisation(_write(tmp_path, expires="2027-06-15"), NOW)


def test_valid_through_the_last_day(tmp_path: Path):
    allowed = load_authorisation(_write(tmp_path), NOW)
    motion = ("comau_ns16", "NS16-42", PROGRAM, 0.5, 10.0)
    allowed.check(*motion, datetime(2026, 12, 31, 23, 59, tzinfo=UTC))
    with pytest.raises(InputError, match="it ended on 2026-12-31"):
        allowed.check(*motion, datetime(2027, 1, 1, 0, 1, tzinfo=UTC))
    assert allowed.ends_soon(datetime(2026, 12, 20, tzinfo=UTC))
    assert allowed.ends_soon(NOW) is None


def test_checks_against_today_by_default(tmp_path: Path):
    today = datetime.now(UTC).date()
    with pytest.raises(InputError, match="more than a year"):
        load_authorisation(_write(tmp_path, expires=str(today + timedelta(days=400))))
    assert load_authorisation(_write(tmp_path, expires=str(today + timedelta(days=60)))).ends_soon() is None
    assert load_authorisation(_write(tmp_path, expires=str(today + timedelta(days=3)))).ends_soon()


@given(speed=st.floats(0.01, 2.0), duration=st.floats(1.0, 4000.0))
def test_covers_only_motion_within_its_limits(speed: float, duration: float):
    assume(abs(speed - 1.0) > 1e-6 and abs(duration - 1200.0) > 1e-3)  # round-off is nobody's breach
    allowed = Authorisation(Path("a"), AuthorisationDocument.model_validate(SAID))
    covered = speed <= 1.0 and duration <= 1200.0
    with nullcontext() if covered else pytest.raises(InputError, match="are allowed"):
        allowed.check("comau_ns16", "NS16-42", PROGRAM, speed, duration, NOW)


def _released(**changes: object) -> Authorisation:
    document = {**SAID, "new_motions": {"duration": "10 min"}, **changes}
    return Authorisation(Path("a"), AuthorisationDocument.model_validate(document))


def test_new_motions_need_their_own_authorisation(tmp_path: Path):
    with pytest.raises(InputError, match="releases no new motions"):
        load_authorisation(_write(tmp_path), NOW).for_new_motion(PROBLEM, "ef" * 32, 0.0)
    allowed = load_authorisation(_write(tmp_path, new_motions={"duration": "10 min"}), NOW)
    word = allowed.for_new_motion(PROBLEM, "ef" * 32, 0.0)
    word.check("comau_ns16", "NS16-42", "ef" * 32, 0.2, 60.0, NOW)
    assert word.unseen
    with pytest.raises(InputError, match="it is for program abababababab"):
        allowed.check("comau_ns16", "NS16-42", "ef" * 32, 0.2, 60.0, NOW)
    with pytest.raises(InputError, match="this authorisation is for problem cdcdcdcdcdcd"):
        allowed.for_new_motion("ef" * 32, "ef" * 32, 0.0)
    for used_up in (600.0, 700.0, float("nan")):
        with pytest.raises(InputError, match="600 s of new motions that it allows are used up"):
            allowed.for_new_motion(PROBLEM, "ef" * 32, used_up)


@given(speed=st.floats(0.01, 2.0), duration=st.floats(1.0, 1500.0), before=st.floats(0.0, 700.0))
def test_new_motions_are_limited_by_the_loop_and_their_own_duration(speed: float, duration: float, before: float):
    allowed = _released(limits={"speed": "1 m/s", "duration": "90 s"})
    assume(all(abs(x) > 1e-3 for x in (speed - 1.0, duration - 90.0, duration - (600.0 - before), before - 600.0)))
    covered = speed <= 1.0 and duration <= 90.0 and before + duration <= 600.0
    with nullcontext() if covered else pytest.raises(InputError, match=r"are allowed|are used up"):
        word = allowed.for_new_motion(PROBLEM, "ef" * 32, before)
        word.check("comau_ns16", "NS16-42", "ef" * 32, speed, duration, NOW)
