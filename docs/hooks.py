"""Hooks of the site: the notebook becomes a page, with what its cells show."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

NOTEBOOK = Path(__file__).with_name("notebook.ipynb")
PAGE = "notebook.md"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    content = "\n\n".join(_cell(cell) for cell in cells)
    files.append(File.generated(config, PAGE, content=content))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to the notebook lead to its page."""
    return markdown.replace(f"({NOTEBOOK.name})", f"({PAGE})")


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
