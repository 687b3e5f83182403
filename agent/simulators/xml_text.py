"""XML changed in place: of the text only the values that change, so comments, order and layout stay as they were."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat


@dataclass(eq=False)
class Tag:
    """An element: where its start tag lies in the text (bytes `start` to `stop`), what is in it, and what is changed.

    `attributes` are as written, with `changed` on top (None: removed); `inserted` are new first children.
    """

    name: str
    attributes: dict[str, str]
    start: int
    stop: int
    children: list[Tag] = field(default_factory=list)
    changed: dict[str, str | None] = field(default_factory=dict)
    inserted: list[str] = field(default_factory=list)

    def get(self, key: str) -> str | None:
        """The attribute as it will be."""
        return self.changed.get(key, self.attributes.get(key))

    def set(self, key: str, value: str | None) -> None:
        """Change an attribute, add it, or remove it (None)."""
        if value != self.attributes.get(key):
            self.changed[key] = value

    def find(self, name: str) -> Tag | None:
        """The first child of that name."""
        return next((child for child in self.children if child.name == name), None)

    def iter(self) -> Iterator[Tag]:
        """Itself and all below it, in the order of the text."""
        yield self
        for child in self.children:
            yield from child.iter()

    @property
    def is_changed(self) -> bool:
        """Whether its own text will differ."""
        return bool(self.changed or self.inserted)


class XmlText:
    """An XML file as text and as elements.

    Raises:
        ValueError: not well-formed, or of an encoding that is no superset of ASCII.
    """

    def __init__(self, text: bytes):
        if b"\x00" in text:
            raise ValueError("its encoding has two bytes a character: save it as UTF-8")
        self.text = text
        self.root = self._parse()

    def _parse(self) -> Tag:
        parser = expat.ParserCreate()
        stack: list[Tag] = []
        found: list[Tag] = []

        def start(name: str, attributes: dict[str, str]) -> None:
            begin = parser.CurrentByteIndex
            tag = Tag(name, dict(attributes), begin, _end_of_tag(self.text, begin))
            (stack[-1].children if stack else found).append(tag)
            stack.append(tag)

        def end(name: str) -> None:
            stack.pop()

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        try:
            parser.Parse(self.text, True)
        except expat.ExpatError as error:
            raise ValueError(str(error)) from None
        return found[0]

    def changed(self) -> bytes:
        """The text with all changes."""
        parts, at = [], 0
        for tag in self.root.iter():
            if tag.is_changed:
                parts += [self.text[at : tag.start], self._rewritten(tag)]
                at = tag.stop
        return b"".join([*parts, self.text[at:]])

    def _rewritten(self, tag: Tag) -> bytes:
        text = self.text[tag.start : tag.stop].decode("latin-1")
        added = ""
        for key, value in tag.changed.items():
            written = re.search(rf"""\s+{re.escape(key)}\s*=\s*("[^"]*"|'[^']*')""", text)
            if written is None:
                added += "" if value is None else f' {key}="{_escaped(value)}"'
            elif value is None:
                text = text[: written.start()] + text[written.end() :]
            else:
                text = f'{text[: written.start(1)]}"{_escaped(value)}"{text[written.end(1) :]}'
        empty = text.endswith("/>")
        body = text[:-2].rstrip() if empty else text[:-1]
        if not tag.inserted:
            space = " " if empty and self.text[tag.stop - 3 : tag.stop - 2].isspace() else ""
            return (body + added + (f"{space}/>" if empty else ">")).encode("latin-1")
        line = self.text.rfind(b"\n", 0, tag.start) + 1
        margin = self.text[line : tag.start].decode("latin-1")
        margin = margin if margin.isspace() or not margin else ""
        inner = "".join(f"\n{margin}  {child}" for child in tag.inserted)
        end = f"\n{margin}</{tag.name}>" if empty else ""
        return f"{body}{added}>{inner}{end}".encode("latin-1")


def _end_of_tag(text: bytes, start: int) -> int:
    """Behind the > of a start tag; a > inside of quotes is text."""
    match = re.compile(rb"""<[^"'>]*(?:(?:"[^"]*"|'[^']*')[^"'>]*)*>""").match(text, start)
    assert match is not None  # the parser accepted it
    return match.end()


def _escaped(value: str) -> str:
    text = value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return text.encode("ascii", "xmlcharrefreplace").decode("ascii")
