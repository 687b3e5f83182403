"""How the source is laid out: what import-linter has no contract for."""

from __future__ import annotations

from pathlib import Path

import grimp

PACKAGES = ("agent", "drivers", "fake_controller")
ROOT = Path(__file__).parents[1]


def test_no_module_imports_itself_by_way_of_others():
    """Import-linter compares neighbours; here a package's own `__init__` counts as well, and lazy imports too."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}
    while leaves := {module for module, imported in imports.items() if not imported}:
        imports = {module: imported - leaves for module, imported in imports.items() if module not in leaves}
    assert not imports, f"a circle of imports goes through some of these: {sorted(imports)}"
