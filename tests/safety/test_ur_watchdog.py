"""No program of a UR runs unless its watchdog is in effect before anything else: reader and driver refuse any other."""

import random
import re

import pytest

from agent.core import InputError
from agent.motion import create_dialect
from drivers.errors import RefusedError
from drivers.transports.ur.program import UrProgram
from fake_controller.ur.script import Go, Request, Script, ScriptError

PREAMBLE = (
    "  write_output_integer_register(25, 4711)",
    "  write_output_integer_register(24, -1)",
    '  rtde_set_watchdog("input_int_register_24", 2, "stop")',
    "  set_tcp(p[0, 0, 0.1, 0, 0, 0])",
    "  set_target_payload(1.5, [0, 0, 0.05])",
    "  while read_input_integer_register(25) != 4711:",
    "    sync()",
    "  end",
    "  write_output_integer_register(25, 0)",
)
HEAD, WATCHDOG = "\n".join(PREAMBLE), PREAMBLE[2].strip()
MOVE = "movej([0, -1.5, 1.5, -1.5, -1.5, 0], a=1, v=0.5)"
IGNORE = 'rtde_set_watchdog("input_int_register_24", 2, "ignore")'


def program(*lines: str, head: str = HEAD) -> str:
    return "\n".join(["def p():", head, *(f"  {line}" for line in lines), f"  {MOVE}", "end", ""])


def wrapped(begin: str, end: str = "  end", lines: str = HEAD) -> str:
    return program(head=f"  {begin}\n{lines}\n{end}")


def changed(old: str, new: str) -> str:
    assert old in HEAD
    return program(head=HEAD.replace(old, new, 1))


#: Accepted by both: spacing, comments, indentation and what comes later are free.
GOOD = {
    "plain": program(),
    "spaced": program().replace("(25, 4711)", "(25,   4711)").replace("\n  ", "\n\t"),
    "commented": program().replace("def p", "# Prüfung\n\ndef p").replace(HEAD, HEAD.replace("\n", "  # sì\n")),
    "without tool": changed(PREAMBLE[3] + "\n", ""),
    "faster": changed(", 2,", ", 8.0,"),
    "function": program("def go(x):", f"  {MOVE}", "end", "go(1)"),
    "loop": program(
        "i = 0", "while i < 3:", f"  {MOVE}", "  write_output_integer_register(24, i)", "  i = i + 1", "end"
    ),
    "wait": program("while not read_input_boolean_register(64):", "  sync()", "end"),
    "message": program('textmsg("at ", get_actual_tcp_pose())'),
}

#: The watchdog is not in effect before the first move, or not for good.
EVASIONS = {
    "no preamble": program(head=""),
    **{f"without line {k}": program(head="\n".join(PREAMBLE[:k] + PREAMBLE[k + 1 :])) for k in (0, 2, 5, 6, 7, 8)},
    "if False": wrapped("if False:"),
    "if True": wrapped("if True:"),
    "if of a register": wrapped("if read_input_boolean_register(64):"),
    "while once": wrapped("while i < 1:", "  i = 1\n  end"),
    "else": wrapped("if True:\n  sync()\n  else:"),
    "function that nobody calls": wrapped("def arm():"),
    "function that is called": wrapped("def arm():", "  end\n  arm()"),
    "thread": wrapped("thread arm():"),
    "thread that runs": wrapped("thread arm():", "  end\n  t = run arm()"),
    "watchdog alone in if": changed(WATCHDOG, f"if False:\n  {WATCHDOG}\n  end"),
    "watchdog on the line of an if": changed(WATCHDOG, f"if False: {WATCHDOG} end"),
    "watchdog commented out": changed(WATCHDOG, f"# {WATCHDOG}"),
    "watchdog in a text": changed(WATCHDOG, 'textmsg("' + WATCHDOG.replace('"', "") + '")'),
    "watchdog in a text that goes on": changed(WATCHDOG, f'textmsg("\n  {WATCHDOG}\n  ")'),
    "watchdog in apostrophes": changed(WATCHDOG, f"textmsg('{WATCHDOG}')"),
    "watchdog behind a line separator in a comment": changed(WATCHDOG, f"# \u2028  {WATCHDOG}"),
    "watchdog behind a next line in a comment": changed(WATCHDOG, f"# \x85  {WATCHDOG}"),
    "watchdog behind a form feed in a comment": changed(WATCHDOG, f"# \x0c  {WATCHDOG}"),
    "watchdog behind a return in a comment": changed(WATCHDOG, f"# \r  {WATCHDOG}"),
    "watchdog after a folder of PolyScope": changed(WATCHDOG, f'$ 1 "x" {WATCHDOG}'),
    "watchdog joined by a backslash": changed(WATCHDOG, WATCHDOG.replace("(", "(\\\n  ")),
    "watchdog of another case": changed("rtde_set", "RTDE_set"),
    "watchdog of full width": changed("rtde_set_watchdog", "ｒtde_set_watchdog"),
    "watchdog assigned": changed(WATCHDOG, f"x = {WATCHDOG}"),
    "watchdog of an alias": changed(WATCHDOG, 'w = rtde_set_watchdog\n  w("input_int_register_24", 2, "stop")'),
    "watchdog named in a variable": changed('"input_int_register_24"', "name"),
    "other register": changed('"input_int_register_24"', '"input_int_register_25"'),
    "ignored": changed('"stop"', '"ignore"'),
    "paused": changed('"stop"', '"pause"'),
    "action left out": changed(', "stop"', ""),
    "action in a variable": changed('"stop"', "act"),
    "action of two texts": changed('"stop"', '"st" "op"'),
    "too slow": changed(", 2,", ", 0.1,"),
    "frequency of zero": changed(", 2,", ", 0,"),
    "frequency of hexadecimal": changed(", 2,", ", 0x2,"),
    "frequency in a variable": changed(", 2,", ", f,"),
    "frequency that is computed": changed(", 2,", ", 2*0+1,"),
    "a fourth argument": changed('"stop")', '"stop", 0)'),
    "a move before": program(head=f"  {MOVE}\n{HEAD}"),
    "a move between": changed(PREAMBLE[3], f"  {MOVE}"),
    "a move before def": f"{MOVE}\n{program()}",
    "a move before def, indented": f"  {MOVE}\n{program()}",
    "a move on the line of def": program().replace("def p():", f"def p(): {MOVE}"),
    "a move in the permit's loop": changed("    sync()", f"    {MOVE}"),
    "a move beside sync": changed("    sync()", f"    sync()\n    {MOVE}"),
    "a move in the permit's condition": changed("25) != 4711", f"25) != 4711 and {MOVE}"),
    "a move in an argument": changed(PREAMBLE[3], f"  set_tcp({MOVE})"),
    "a move in an index": changed("0.1, 0", f"[0.1, 0.1][{MOVE}], 0"),
    "a speed before": program(head=f"  speedl([0, 0, 0.1, 0, 0, 0], 0.5)\n{HEAD}"),
    "a call before": program("def go():", f"  {MOVE}", "end", head=f"  go()\n{HEAD}"),
    "a routine named sync": program("def sync():", f"  {MOVE}", "end"),
    "a routine named sync before": program(head=f"  def sync():\n    {MOVE}\n  end\n{HEAD}"),
    "a routine named as the watchdog": program("def rtde_set_watchdog(a, b, c):", "  sync()", "end"),
    "a routine named as the question": program("def read_input_integer_register(n):", f"  {MOVE}", "end"),
    "a routine named as the answer": program("def write_output_integer_register(n, v):", f"  {MOVE}", "end"),
    "another permit": changed("25) != 4711", "25) != 0"),
    "a permit of another register": changed("register(25) !=", "register(26) !="),
    "a permit turned round": changed("!= 4711", "== 4711"),
    "a permit that is there already": program().replace("4711", "0"),
    "a permit that no register holds": program().replace("4711", "2147483648"),
    "no permit by or": changed("!= 4711:", "!= 4711 and False:"),
    "ignored later": program(IGNORE),
    "ignored after the moves": program(MOVE, IGNORE),
    "set again": program(WATCHDOG),
    "another payload later": program("set_target_payload(9, [0, 0, 0])"),
    "another payload in an if": program("if True:", "  set_payload(9)", "end"),
    "another payload in the first statements": changed(
        PREAMBLE[4], f"{PREAMBLE[4]}\n  set_target_payload(9, [0, 0, 0])"
    ),
    "another TCP later": program("set_tcp(p[0, 0, 0.3, 0, 0, 0])"),
    "ignored later in if": program("if False:", f"  {IGNORE}", "end"),
    "ignored later in a routine": program("def off():", f"  {IGNORE}", "end"),
    "ignored later in another case of spacing": program(IGNORE.replace("(", " ( ")),
    "ignored later on a line of its own name": program("rtde_set_watchdog", '("input_int_register_24", 2, "ignore")'),
    "ignored in a waiting loop": program("while not read_input_boolean_register(64):", f"  {IGNORE}", "end"),
    "ignored in an argument": program(f"sleep({IGNORE})"),
    "ignored in a thread": program("thread off():", f"  {IGNORE}", "end", "t = run off()"),
    "ignored as an argument's default": program(f"def go(x={IGNORE}):", "  sync()", "end"),
    "ignored behind a comment's return": program(f"# \r  {IGNORE}"),
    "ignored behind a second statement": program(f"sync() {IGNORE}"),
    "ignored behind a semicolon": program(f"sync(); {IGNORE}"),
    "the driver's register": program("write_output_integer_register(25, 4711)"),
    "the driver's register by a sum": program("write_output_integer_register(24 + 1, 4711)"),
    "the driver's register after a blank": program("write_output_integer_register (25, 4711)"),
    "the driver's register with a zero before": program("write_output_integer_register(025, 4711)"),
    "the driver's register by an alias": program("w = write_output_integer_register", "w(25, 4711)"),
    "a second program": program() + f"def q():\n  {MOVE}\nend\n",
    "a secondary program": program() + f"sec q():\n  {IGNORE}\nend\n",
    "a move after the end": program() + f"{MOVE}\n",
    "an end too early, at the left edge": program().replace("  end\n", "end\n", 1),
    "an unbalanced end": program("end", f"def q():\n  {MOVE}"),
    "moved by a script of a socket": program('socket_open("127.0.0.1", 30002)', 'socket_send_string("def q(): end")'),
    "a parameter": program().replace("def p()", "def p(x)"),
}


def readers():
    yield lambda text: create_dialect("urscript").read(text, "t.script"), InputError
    yield UrProgram.of, RefusedError


@pytest.mark.parametrize("name", GOOD)
def test_a_watched_program_is_accepted(name):
    for read, _ in readers():
        read(GOOD[name])


@pytest.mark.parametrize("name", EVASIONS)
def test_a_program_that_escapes_its_watchdog_is_refused_by_the_reader(name):
    with pytest.raises(InputError, match=r"t\.script"):
        create_dialect("urscript").read(EVASIONS[name], "t.script")


#: These do not touch the watchdog of the text; the reader alone follows what else they do.
OF_THE_READER = {
    "a speed before": False,
    "ignored in a thread": False,
    "moved by a script of a socket": True,
}


@pytest.mark.parametrize("name", [name for name in EVASIONS if not OF_THE_READER.get(name, False)])
def test_a_program_that_escapes_its_watchdog_is_refused_by_the_driver(name):
    """Which has its own reading of a text, line by line."""
    with pytest.raises(RefusedError):
        UrProgram.of(EVASIONS[name])


def effects(text: str) -> list[tuple[str, tuple[object, ...]]]:
    """What a controller does with a program, by the emulator's own grammar, until it has moved three times."""
    done: list[tuple[str, tuple[object, ...]]] = []
    permit: list[int] = []

    def records(name):
        def act(*values, **named):
            done.append((name, (*values, *named.values())))
            if name == "write_output_integer_register" and values[0] == 25 and values[1]:
                permit.append(int(values[1]))
            return Go(None) if name.startswith("move") else Request(lambda *_: None)

        return act

    asked = {"read_input_integer_register": lambda _: permit[-1] if permit else 0}
    asked |= {"read_input_boolean_register": lambda _: True, "get_actual_tcp_pose": lambda: 0, "d2r": float}
    names = set(re.findall(r"\w+(?= *\()", text)) - asked.keys() - set(re.findall(r"(?:def|thread) +(\w+)", text))
    try:
        script = Script(text, {**{name: records(name) for name in names}, **asked})
        for steps, _ in enumerate(script.run()):
            if steps > 200 or sum(name.startswith("move") for name, _ in done) > 3:
                break
    except ScriptError:
        pass
    return done


def unwatched(text: str) -> str:
    """Why a program moves without its watchdog; empty if it does not."""
    done = [one for one in effects(text) if one[0] in ("rtde_set_watchdog", "movej", "movel", "speedl", "stopl")]
    watched = [one for one in done if one[0] == "rtde_set_watchdog"]
    if done and done[0][0] != "rtde_set_watchdog":
        return f"{done[0][0]} comes first"
    good = len(watched) == 1 and watched[0][1][::2] == ("input_int_register_24", "stop") and watched[0][1][1] >= 2
    return "" if good or not done else f"{watched}"


PIECES = [
    *(line.strip() for line in PREAMBLE),
    *(MOVE, IGNORE, WATCHDOG, "if False:", "if True:", "else:", "end", "def f():", "f()", "thread g():", "run g()"),
    *("while i < 2:", "i = i + 1", "i = 0", "sync()", "speedl([0,0,0,0,0,0], 1)", "#", '"', "(", ")", "'", "\\", "\r"),
    *("global", "local x = 1", "sync = 1", "def sync():", "return", "halt", ";", ":", "\x0b", 'textmsg("', '")', "not"),
]


def edited(rng: random.Random, text: str) -> str:
    """A few edits of lines, and of pieces within them."""
    lines = text.split("\n")
    for _ in range(rng.randint(1, 4)):
        at, piece = rng.randrange(len(lines)), rng.choice(PIECES)
        match rng.randrange(6):
            case 0:
                lines.insert(at, f"  {piece}")
            case 1:
                del lines[at]
                lines = lines or [""]
            case 2:
                other = rng.randrange(len(lines))
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at] = f"{lines[at]} {piece}" if rng.random() < 0.5 else f"  {piece} {lines[at].strip()}"
            case 4:
                middle = rng.randint(0, len(lines[at]))
                lines[at] = lines[at][:middle] + piece + lines[at][middle:]
            case _:
                end = min(len(lines), at + rng.randint(1, 4))
                lines[at:end] = [f"  {rng.choice(PIECES)}", *lines[at:end], "  end"]
    return "\n".join(lines)


def check_edits(seed: int, count: int) -> int:
    rng, taken = random.Random(seed), 0
    for _ in range(count):
        text = edited(rng, rng.choice([*GOOD.values()]))
        for read, refused in readers():
            try:
                read(text)
            except refused:
                continue
            taken += 1
            assert not unwatched(text), text
    return taken


def test_whatever_is_accepted_after_edits_is_watched_by_the_emulators_own_reading():
    assert check_edits(5, 1500) > 50


@pytest.mark.verify
def test_whatever_is_accepted_after_many_edits_is_watched():
    assert check_edits(6, 30_000) > 1500


def test_the_emulators_reading_tells_an_evasion():
    """Or the property above would hold of any reader."""
    assert unwatched(program(IGNORE))
    assert unwatched(wrapped("if False:"))
    assert unwatched(program(head=f"  {MOVE}\n{HEAD}"))
    assert not any(unwatched(text) for text in GOOD.values())
