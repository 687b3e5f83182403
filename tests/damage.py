"""JSON documents in which one value, anywhere, is wrong."""

import json
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

#: Values that may replace an expected one.
WRONG = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**40), 10**40),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(["\ud800", "\x1b[2J", "1e999"]),
    st.lists(st.integers() | st.floats(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.none(), max_size=2),
)


def _places(data: Any, way: tuple = ()) -> Iterator[tuple]:
    """Ways to every value of a document."""
    yield way
    items = data.items() if isinstance(data, dict) else enumerate(data[:2]) if isinstance(data, list) else ()
    for key, value in items:
        yield from _places(value, (*way, key))


@st.composite
def damaged(draw: st.DrawFn, document: Any) -> Any:
    """The document with one changed value."""
    document = json.loads(json.dumps(document))
    way, wrong = draw(st.sampled_from(list(_places(document)))), draw(WRONG)
    if not way:
        return wrong
    holder = document
    for key in way[:-1]:
        holder = holder[key]
    holder[way[-1]] = wrong
    return document
