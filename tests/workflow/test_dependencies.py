"""What the library imports is what `pip install .` brings."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_import_of_the_library_is_a_dependency():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    # Of laspy[lazrs] both.
    declared = {normal(name) for line in declared for name in re.findall(r"[A-Za-z][A-Za-z0-9_.-]*", re.split("[<>=~!;]", line)[0])}
    owners, missing = packages_distributions(), {}
    for path in (ROOT / "streetscan").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                names = [node.module] if isinstance(node, ast.ImportFrom) else []
            for name in {n.split(".")[0] for n in names} - set(sys.stdlib_module_names) - {"streetscan"}:
                if not {normal(d) for d in owners.get(name, [name])} & declared:
                    missing[name] = path.name
    assert missing == {}
