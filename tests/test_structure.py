"""The guards of the house: what may import what, and how long files and functions may be."""

import ast
from pathlib import Path

import pytest

from tests.conftest import FAST

ROOT = Path(__file__).parents[1]
PACKAGE = "dbdnet_jax"
MAX_FILE_LINES = 300
MAX_FUNCTION_LINES = 60

# A room, or a file at the top, may import only what stands above it; inside a room no import may
# lead back to where it came from.
ROOMS = """
types errors
ops io metrics classical networks data training alignment evaluation drawing
cli __main__
""".split()
SCRIPTS = ("train", "evaluate")  # may import the package, not each other


def module_name(path: Path, root: Path) -> str:
    """``dbdnet_jax/ops/rigid.py`` is ``dbdnet_jax.ops.rigid``; a package is its folder."""
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_names(path: Path, root: Path) -> set[str]:
    """Absolute dotted names of everything imported anywhere in a file, functions included."""
    package = path.relative_to(root).parent.parts
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else ()
            base = ".".join((*base, *((node.module,) if node.module else ())))
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def room(name: str) -> str | None:
    """The room of a dotted name of the package; None for other libraries."""
    first, *rest = name.split(".")
    if first in SCRIPTS:
        return first
    if first != PACKAGE:
        return None
    # A public name is the package's own __init__, which imports everything.
    return rest[0] if rest and rest[0] in ROOMS else PACKAGE


def rank(name: str) -> int:
    """The place of a room; public names stand below all of them, and scripts below these."""
    return (*ROOMS, PACKAGE).index(name) if name not in SCRIPTS else len(ROOMS) + 1


def module_of(name: str, modules: set[str]) -> str | None:
    """The module that an imported name is, or is from."""
    return next((n for n in (name, name.rpartition(".")[0]) if n in modules), None)


def cycles(imports: dict[str, set[str]]) -> list[str]:
    """Modules that a chain of imports leads back to."""
    problems = []
    for start in sorted(imports):
        reached, waiting = set(), [start]
        while waiting:
            new = imports.get(waiting.pop(), set()) - reached
            reached |= new
            waiting += new
        if start in reached:
            problems.append(f"{start} imports itself by way of others")
    return problems


def back_edges(root: Path) -> list[str]:
    """Imports of what does not stand above the importing file, and files without a room."""
    problems = []
    paths = [root / f"{script}.py" for script in SCRIPTS] + sorted((root / PACKAGE).rglob("*.py"))
    paths = [path for path in paths if path.exists()]
    modules = {module_name(path, root) for path in paths}
    inside: dict[str, set[str]] = {}
    for path in paths:
        name = module_name(path, root)
        if name == PACKAGE:
            continue
        own = room(name)
        if own == PACKAGE:
            problems.append(f"{name} has no room; move it into one of {', '.join(ROOMS)}")
            continue
        for imported in sorted(imported_names(path, root)):
            theirs = room(imported)
            if theirs == own:
                inside.setdefault(name, set()).add(module_of(imported, modules) or imported)
            elif theirs is not None and rank(theirs) >= rank(own):
                problems.append(f"{name} imports {imported}, which does not stand above it")
    return problems + cycles(inside)


def too_long(root: Path) -> list[str]:
    """Files and functions above their limits, decorators not counted."""
    problems = []
    paths = [root / f"{script}.py" for script in SCRIPTS]
    for folder in (PACKAGE, "configs", "tools", "tests", "benchmarks"):
        paths += sorted((root / folder).rglob("*.py"))
    for path in (path for path in paths if path.exists()):
        text, name = path.read_text(), path.relative_to(root)
        lines = len(text.splitlines())
        if lines > MAX_FILE_LINES:
            problems.append(f"{name} has {lines} lines, {MAX_FILE_LINES} are allowed")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = node.end_lineno - node.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    problems.append(
                        f"{name}: {node.name} has {lines} lines, {MAX_FUNCTION_LINES} are allowed"
                    )
    return problems


def test_every_file_imports_only_what_stands_above_it():
    assert back_edges(ROOT) == []


def test_no_file_and_no_function_is_too_long():
    assert too_long(ROOT) == []


def plant(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("dbdnet_jax/ops/rigid.py", "from dbdnet_jax.losses import focal\n"),
        ("dbdnet_jax/ops/rigid.py", "from dbdnet_jax import losses\n"),
        ("dbdnet_jax/ops/rigid.py", "import dbdnet_jax.losses as losses\n"),
        ("dbdnet_jax/ops/rigid.py", "from ..losses import focal\n"),
        ("dbdnet_jax/ops/rigid.py", "from .. import losses\n"),
        ("dbdnet_jax/ops/rigid.py", "from dbdnet_jax.ops import rigid\n"),
        ("dbdnet_jax/ops/rigid.py", "from . import rigid\n"),
        ("dbdnet_jax/ops/rigid.py", "def lazy():\n    from dbdnet_jax.ops.rigid import a\n"),
        ("dbdnet_jax/ops/rigid.py", "from dbdnet_jax import register\n"),
        ("dbdnet_jax/ops/__init__.py", "from dbdnet_jax.data.pairs import make_pair\n"),
        ("dbdnet_jax/cli.py", "import train\n"),
        ("dbdnet_jax/forgotten.py", ""),
        ("train.py", "from evaluate import main\n"),
    ],
)
def test_a_planted_back_edge_is_caught(tmp_path, name, text):
    plant(tmp_path, name, text)
    assert len(back_edges(tmp_path)) == 1


def test_a_planted_circle_in_a_room_is_caught(tmp_path):
    plant(tmp_path, "dbdnet_jax/ops/a.py", "from dbdnet_jax.ops.b import x\n")
    plant(tmp_path, "dbdnet_jax/ops/b.py", "def lazy():\n    from dbdnet_jax.ops import c\n")
    plant(tmp_path, "dbdnet_jax/ops/c.py", "from . import a\n")
    assert len(back_edges(tmp_path)) == 3


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("dbdnet_jax/__init__.py", "from dbdnet_jax.cli import main\n"),
        ("dbdnet_jax/ops/rigid.py", "import jax\nfrom dbdnet_jax.types import Rigid\n"),
        (
            "dbdnet_jax/networks/blocks.py",
            "from ..ops import rigid\nfrom ..ops.rigid import apply\n",
        ),
        ("train.py", "from dbdnet_jax import register\nfrom dbdnet_jax.cli import main\n"),
    ],
)
def test_an_import_of_what_stands_above_is_allowed(tmp_path, name, text):
    plant(tmp_path, name, text)
    assert back_edges(tmp_path) == []


def test_a_planted_long_file_and_a_planted_long_function_are_caught(tmp_path):
    plant(tmp_path, "dbdnet_jax/a.py", "x = 1\n" * (MAX_FILE_LINES + 1))
    plant(tmp_path, "tests/b.py", "x = 1\n" * MAX_FILE_LINES)
    body = "    x = 1\n" * MAX_FUNCTION_LINES
    plant(tmp_path, "tests/c.py", "class C:\n" + f"  def long():\n{body}".replace("    ", "      "))
    short = body.removesuffix("    x = 1\n")
    plant(tmp_path, "train.py", f"@wraps(\n    f\n)\ndef short():\n{short}")
    assert too_long(tmp_path) == [
        f"dbdnet_jax/a.py has {MAX_FILE_LINES + 1} lines, {MAX_FILE_LINES} are allowed",
        f"tests/c.py: long has {MAX_FUNCTION_LINES + 1} lines, {MAX_FUNCTION_LINES} are allowed",
    ]


def test_every_room_has_fast_tests():
    tests = ROOT / "tests"
    assert all((tests / name).exists() for name in FAST)
    rooms = {path.name for path in (ROOT / PACKAGE).iterdir() if (path / "__init__.py").exists()}
    assert rooms <= {name.split("/")[0] for name in FAST}
