"""Changes an XML file through ElementTree elements and keeps every byte that did not change.

Comments, order, layout and quotes stay as people wrote them, which no XML library keeps: lxml rewrites start tags, and
MuJoCo's MjSpec drops comments, includes and units.
"""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element, TreeBuilder, tostring
from xml.parsers import expat


class XmlDocument:
    """An XML file; names and attributes of elements below `root` may be changed, and new children added to them.

    Raises:
        ValueError: not well-formed, or of an encoding that is no superset of ASCII.
    """

    def __init__(self, text: bytes):
        if b"\x00" in text:
            raise ValueError("its encoding has two bytes a character: save it as UTF-8")
        self._text = text
        self._written: list[tuple[Element, int, dict[str, str]]] = []  # start in the text, attributes as written
        self._ended: dict[int, tuple[int, str]] = {}  # end of an element in the text, name as written
        parser, builder = expat.ParserCreate(), TreeBuilder()

        def start(name: str, attributes: dict[str, str]) -> None:
            self._written.append((builder.start(name, dict(attributes)), parser.CurrentByteIndex, attributes))

        def end(name: str) -> None:
            self._ended[id(builder.end(name))] = parser.CurrentByteIndex, name

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            raise ValueError(str(error)) from None
        self.root: Element = builder.close()

    @property
    def is_changed(self) -> bool:
        """Whether anything changed."""
        return self.changed() != self._text

    def changed(self) -> bytes:
        """The text with all changes."""
        known = {id(element) for element, _, _ in self._written}
        edits = []
        for element, start, attributes in self._written:
            new = [child for child in element if id(child) not in known]
            end, name = self._ended[id(element)]
            if new or element.attrib != attributes or element.tag != name:
                stop = _end_of_tag(self._text, start)
                edits.append((start, stop, self._rewritten(element, attributes, new, start, stop)))
                if element.tag != name and self._text[stop - 2 : stop] != b"/>":
                    edits.append((end, end + len(name.encode()) + 2, f"</{element.tag}".encode()))
        parts, at = [], 0
        for start, stop, text in sorted(edits):
            parts += [self._text[at:start], text]
            at = stop
        return b"".join([*parts, self._text[at:]])

    def _rewritten(
        self, element: Element, attributes: dict[str, str], new: list[Element], start: int, stop: int
    ) -> bytes:
        """The start tag with its current attributes, followed by new children."""
        tag = re.sub(r"^<[^\s/>]+", f"<{element.tag}", self._text[start:stop].decode("latin-1"))
        added = ""
        for key in {**attributes, **element.attrib}:
            value = element.get(key)
            if value == attributes.get(key):
                continue
            written = re.search(rf"""\s+{re.escape(key)}\s*=\s*("[^"]*"|'[^']*')""", tag)
            if written is None:
                added += f' {key}="{_escaped(value or "")}"'
            elif value is None:
                tag = tag[: written.start()] + tag[written.end() :]
            else:
                tag = f'{tag[: written.start(1)]}"{_escaped(value)}"{tag[written.end(1) :]}'
        empty = tag.endswith("/>")
        body = (tag[:-2] if empty else tag[:-1]).rstrip()
        close = tag[len(body) :]
        if not new:
            return f"{body}{added}{close}".encode("latin-1")
        margin = self._text[self._text.rfind(b"\n", 0, start) + 1 : start].decode("latin-1")
        margin = margin if margin.isspace() else ""
        inner = "".join(f"\n{margin}  {tostring(child, 'unicode').replace(' />', '/>')}" for child in new)
        end = f"\n{margin}</{element.tag}>" if empty else ""
        return f"{body}{added}>{inner}{end}".encode("latin-1")


def _end_of_tag(text: bytes, start: int) -> int:
    """Index behind the > of a start tag; a > inside quotes is text."""
    match = re.compile(rb"""<[^"'>]*(?:(?:"[^"]*"|'[^']*')[^"'>]*)*>""").match(text, start)
    assert match is not None  # the parser accepted it
    return match.end()


def _escaped(value: str) -> str:
    text = value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return text.encode("ascii", "xmlcharrefreplace").decode("ascii")
