"""The script interpreter, through the ports of the emulated UR."""

import math

import pytest
from hypothesis import given, strategies as st

from fake_controller.ur.script import Request, Script, ScriptError, command, pause
from tests.ur_fake.clients import Primary, Rtde, clients, errors, program, texts


def run(ur, *lines):
    """Messages of a program, and its errors."""
    with clients(Primary(ur)) as client:
        client.send(program(*lines).encode())
        said = client.ended()
    return texts(said), errors(said)


def value_of(expression):
    """The value of an expression, with only textmsg defined."""
    said = []
    known = {"textmsg": lambda value: command(lambda _: said.append(value))}
    script = Script(f"def f():\n  textmsg({expression})\nend\n", known)
    for request in script.run():
        request.act(None, None)
    return said[0]


leaves = st.integers(0, 99).map(str) | st.floats(0, 1e3).map(repr) | st.sampled_from(["True", "False"])
signs = st.sampled_from(["+", "-", "*", "<", "<=", "==", "!=", "and", "or"])
forms = ["({1} {0} {2})", "(not {1})", "(-{1})"]
expressions = st.recursive(
    leaves, lambda inner: st.builds(str.format, st.sampled_from(forms), signs, inner, inner), max_leaves=8
)


@given(expressions)
def test_an_expression_has_the_value_that_it_has_in_python(expression):
    expected = eval(expression, {"__builtins__": {}})
    if " and " in expression or " or " in expression:
        assert bool(value_of(expression)) == bool(expected)
    else:
        assert value_of(expression) == expected


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("1 + 2 * 3", 7),
        ("7 / 2", 3.5),
        ("7 % 4 - -1", 4),
        ("not 1 == 2 and 3 > 2", True),
        ("True xor False", True),
        ("[1, [2, 3]][1][0]", 2),
        ("p[1, 2, 3, 4, 5, 6][5]", 6),
        ('"a # b"', "a # b"),
        (".5e1", 5.0),
    ],
)
def test_operators_bind_as_documented(expression, expected):
    assert value_of(expression) == expected


def test_loops_branches_functions_and_scopes_work_as_documented(ur):
    lines = """
    global total = 0          # ends of lines are blanks, and a comment ends with its line
    def add(n, times=2): total = total + n * times end
    def sign(x):
      if x > 0: return "plus" elif x == 0: return "zero" else: return "minus" end
    end
    i = 0
    while True:
      i = i + 1
      if i == 2: continue end
      if i > 4: break end
      add(i)
      add(times=1, n=10)
    end
    values = [1, 2, 3]
    other = values
    other[1] = sign(-1)
    textmsg("total ", total)
    textmsg(values)
    textmsg(other)
    local i = 7
    textmsg(sign(i))
    """
    said, wrong = run(ur, *lines.splitlines())
    assert wrong == []
    assert said == ["total 46", "[1, 2, 3]", "[1, 'minus', 3]", "plus"]


def test_threads_run_side_by_side(ur):
    lines = """
    global count = 0
    thread counting():
      while True:
        count = count + 1
        sync()
      end
    end
    thread short():
      sleep(0.1)
      textmsg("short is over")
    end
    handle = run counting()
    other = run short()
    join other
    seen = count
    kill handle
    sleep(0.1)
    if count == seen or count == seen + 1: textmsg("killed") end
    if seen > 40 and seen < 60: textmsg("one turn a cycle") end
    """
    assert run(ur, *lines.splitlines()) == (["short is over", "killed", "one turn a cycle"], [])


@pytest.mark.parametrize(
    ("lines", "line", "text"),
    [
        (["x = 1", "nowhere(x)"], 3, "compile_error_name_not_found:nowhere:"),
        (["x = = 1"], 2, "compile_error_syntax_error"),
        (["if True:", "x = 1"], 4, "compile_error_syntax_error"),
    ],
)
def test_an_invalid_script_is_refused_with_its_line(ur, lines, line, text):
    with clients(Primary(ur)) as client:
        client.send((program(*lines) + "end\n" * (text.endswith("error") and lines[0].startswith("if"))).encode())
        found = errors([client.message()])[0]
    assert found[2].startswith(text)
    if lines[0] != "if True:":
        assert found[0] == line


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("y = x", "the variable x has no value"),
        ("y = [1][2]", "list index out of range"),
        ('y = "a" + 1', "a number is expected"),
        ("y = 1 / 0", "division by zero"),
        ("movej([0, 0], a=1)", "targets have 6 numbers"),
        ("movej([0, 0, 0, 0, 0, 0], v=0)", "must be above 0"),
        ("movel(p[9, 9, 9, 0, 0, 0])", "out of reach"),
        ("set_target_payload(-1, [0, 0, 0])", "cannot be a payload"),
        ("write_output_integer_register(48, 1)", "there is no register 48"),
        ("servoj([0, 0, 0, 0, 0, 0])", "does not carry it out"),
        ("while True: x = 1 end", "needs sync() or sleep()"),
    ],
)
def test_an_error_ends_the_program_and_is_reported_with_its_line(start_ur, line, text):
    ur = start_ur()
    said, wrong = run(ur.address, "sync()", line, 'textmsg("too far")')
    assert said == []
    ((number, _, told),) = wrong
    assert text in told
    assert number == 3 or "sync()" in told
    assert ur.cell.history() == "motions started 1; ended: program_error; at rest"


def test_endless_recursion_is_an_error():
    script = Script("def f():\n  def g(): g() end\n  g()\nend\n", {})
    with pytest.raises(ScriptError, match="g cannot be called like that"):
        list(script.run())


def test_a_script_reads_poses_tool_payload_and_registers(ur):
    lines = """
    set_tcp(p[0, 0, 0.1, 0, 0, 0])
    set_gravity([0, 0, 9.82])
    q = get_target_joint_positions()
    near = get_inverse_kin(get_forward_kin(q), q)
    if norm([near[0] - q[0], near[1] - q[1], near[2] - q[2], near[3] - q[3]]) < 1e-6: textmsg("inverse") end
    if get_inverse_kin_has_solution(p[3, 0, 0, 0, 0, 0]): textmsg("too far") end
    if is_within_safety_limits(q): textmsg("within") end
    half = pose_trans(p[0, 0, 1, 0, 0, d2r(90)], p[1, 0, 0, 0, 0, 0])
    if point_dist(half, p[0, 1, 1, 0, 0, 0]) < 1e-9: textmsg("turned") end
    if norm(pose_sub(pose_trans(half, pose_inv(half)), p[0, 0, 0, 0, 0, 0])) < 1e-9: textmsg("back") end
    write_output_float_register(30, 2.5)
    write_output_boolean_register(70, True)
    textmsg(get_tcp_offset())
    textmsg(get_target_payload_cog())
    textmsg(read_input_integer_register(24))
    """
    said, wrong = run(ur, *lines.splitlines())
    assert wrong == []
    assert said == ["inverse", "within", "turned", "back", "p[0.0, 0.0, 0.1, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0]", "0"]
    names = "output_double_register_30", "output_bit_register_70", "output_bit_registers32_to_63"
    with clients(Rtde(ur, *names)) as rtde:
        assert [*rtde.sample().values()] == [2.5, True, 0]


def test_sleep_lasts_as_long_as_it_says(ur):
    with clients(Primary(ur)) as primary:
        primary.send(program('textmsg("from")', "sleep(0.5)", 'textmsg("to")').encode())
        times = []
        while len(times) < 2:
            kind, data = primary.receive()
            if kind == 20 and data[9] == 0:
                times.append(1e-6 * int.from_bytes(data[:8], "big"))
    assert math.isclose(times[1] - times[0], 0.5, abs_tol=0.02)


def test_an_idle_loop_requests_nothing_but_pauses():
    script = Script("def f():\n  i = 0\n  while i < 3: i = i + 1 sync() end\nend\n", {"sync": lambda: pause(0)})
    assert [type(request) for request in script.run()] == [type(None), Request] * 3
