"""Hooks of the site: the notebook becomes a page, with what its cells show, and the decisions get an index."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

DOCS = Path(__file__).parent
#: What pages link to in the repository, and the page of the site.
PAGES = {"notebook.ipynb": "notebook.md", "decisions/": "decisions/index.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add both pages."""
    notebook, index = PAGES.values()
    files.append(File.generated(config, notebook, content=_notebook()))
    files.append(File.generated(config, index, content=_decisions()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links lead to the pages of the site."""
    for source, page in PAGES.items():
        markdown = markdown.replace(f"]({source})", f"]({page})")
    return markdown


def _decisions() -> str:
    records = sorted((DOCS / "decisions").glob("*.md"))
    titles = [path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ") for path in records]
    return "\n".join(
        ["# Decisions", "", *(f"- [{title}]({path.name})" for title, path in zip(titles, records, strict=True))]
    )


def _notebook() -> str:
    cells = json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    return "\n\n".join(_cell(cell) for cell in cells)


def _cell(cell: dict[str, Any]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return source
    return "\n\n".join([f"```python\n{source}\n```", *(_output(output["data"]) for output in cell["outputs"])])


def _output(data: dict[str, Any]) -> str:
    if "text/html" in data:
        html = "".join(line for line in "".join(data["text/html"]).splitlines(keepends=True) if line.strip())
        return f"<div>\n{html}\n</div>"
    return f"```text\n{''.join(data['text/plain'])}\n```"
