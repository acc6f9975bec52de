"""The site builds without a warning, and what its pages and the notebook name is there."""

import ast
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dbdnet_jax.cli.arguments import make_parser

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOK = ROOT / "notebooks" / "quick_start.ipynb"
OURS = r"(configs|examples|tests|tools|benchmarks|docs)/[^_]"  # folders; docs/_build is made


def fenced(page: Path, language: str) -> list[str]:
    """The code blocks of a page in a language."""
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL)


def commands(page: Path) -> list[str]:
    """The commands of a page; comments and continued lines are taken care of."""
    text = "\n".join(fenced(page, "bash")).replace("\\\n", " ")
    lines = [line.split("#")[0] for line in text.splitlines()]
    return [part.strip() for line in lines for part in line.split("&&") if part.strip()]


def flags_of(script: Path) -> set[str]:
    """Names of the flags that a script defines, itself or in what it imports from its folder."""
    if not script.is_file():
        return set()
    text = script.read_text()
    names = set(re.findall(r'DEFINE_\w+\(\s*"(\w+)"', text))
    names |= set(re.findall(r'add_argument\(\s*"--([\w-]+)"', text))
    for name in re.findall(r"^from benchmarks\.(\w+) import", text, re.MULTILINE):
        names |= flags_of(ROOT / "benchmarks" / f"{name}.py")
    if "import launch\n" in text:
        names |= flags_of(ROOT / "dbdnet_jax" / "training" / "launch.py")
    return names


def has_field(config: str, path: str) -> bool:
    """Whether a configuration file has the field ``a.b``."""
    node = importlib.import_module(f"configs.{Path(config).stem}").get_config()
    for name in path.split("."):
        if name not in node:
            return False
        node = node[name]
    return True


def wrong_words(command: str) -> list[str]:
    """What a command names that is not there: a script of ours, its flags, fields, files."""
    problems = [
        word
        for word in re.split(r"[ =]", command)
        if re.match(OURS, word) and not (ROOT / word).exists()
    ]
    if match := re.search(r"python (?:-m ((?:benchmarks|tools)\.\w+)|(\S+)\.py)", command):
        script = ROOT / f"{(match[1] or match[2]).replace('.', '/')}.py"
        if script.with_suffix("").is_dir():
            script = script.with_suffix("") / "__main__.py"
        known = flags_of(script)
        problems += [] if script.is_file() else [match[0]]
    elif match := re.match("dbdnet-register", command):
        actions = make_parser()._actions
        known = {option.lstrip("-") for action in actions for option in action.option_strings}
    else:
        return problems  # of another project
    config = re.search(r"--config=(\S+)", command)
    for flag in re.findall(r" --?([\w.-]+)", command[match.end() :]):
        field = flag.removeprefix("config.")
        if field == flag:
            problems += [] if flag in known else [flag]
        elif not (config and (ROOT / config[1]).is_file() and has_field(config[1], field)):
            problems.append(flag)
    return problems


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_name_scripts_flags_and_files_that_exist(page):
    assert [(x, wrong) for x in commands(page) if (wrong := wrong_words(x))] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_of_tests_that_a_page_names_exist(page):
    named = set(re.findall(r"\btests/[\w/]+\.\w+", page.read_text()))
    assert [x for x in named if "NAME" not in x and not (ROOT / x).is_file()] == []


@pytest.mark.parametrize(
    ("command", "wrong"),
    [
        ("python train.py --config=configs/cad.py --config.train.start=a.npz --stage=both", []),
        ("python train.py --config=configs/cad.py --stages=both", ["stages"]),
        ("python train.py --config=configs/cad.py --config.train.epoch=1", ["config.train.epoch"]),
        ("python train.py --config=configs/none.py", ["configs/none.py"]),
        ("taskset -c 0 python trian.py", ["python trian.py"]),
        ("python -m benchmarks.none", ["python -m benchmarks.none"]),
        ("dbdnet-register a.ply b.ply -o t.txt --no-refine", []),
        ("dbdnet-register examples/a.ply b.ply --refined", ["examples/a.ply", "refined"]),
        ("pip install -e . && sphinx-build -W -b html docs docs/_build", []),
    ],
)
def test_a_planted_mistake_in_a_command_is_caught(command, wrong):
    assert wrong_words(command) == wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_blocks_parse_and_their_imports_and_names_exist(page):
    for block in fenced(page, "python"):
        tree = ast.parse(block)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module or "")
                for alias in node.names:
                    importable = f"{node.module}.{alias.name}"
                    assert hasattr(module, alias.name) or importlib.import_module(importable)
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                if node.value.id == "dbdnet_jax":
                    assert hasattr(importlib.import_module("dbdnet_jax"), node.attr), node.attr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tests_and_files_that_a_page_names_exist(page):
    text = page.read_text()
    found = list((ROOT / "tests").rglob("test_*.py"))
    sources = {path: path.read_text() for path in found}
    names = {path.name for path in found}
    for name in re.findall(r"\b(test_\w+)\.py", text):
        assert f"{name}.py" in names
    for name in re.findall(r"`(test_\w+)`", text):
        assert any(f"def {name}(" in source for source in sources.values()), name
    for name in re.findall(r"`((?:dbdnet_jax|configs|tools|examples|docs)/[\w./]+)`", text):
        assert "NAME" in name or (ROOT / name).exists(), name
    for name in re.findall(
        r"`((?:classical|data|alignment|evaluation|io|metrics|networks|ops|training)/[\w/]+\.py)`",
        text,
    ):
        assert (ROOT / "dbdnet_jax" / name).exists(), name


def build(source: Path, target: Path) -> subprocess.CompletedProcess:
    """The site's command, in a process of its own."""
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [*command, source, target], env=environment, capture_output=True, text=True
    )


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("furo", reason="the docs extra (Sphinx, MyST, furo) is not installed")
    run = build(ROOT / "docs", tmp_path / "site")
    assert run.returncode == 0, run.stderr
    api = (tmp_path / "site" / "api.html").read_text()
    for name in importlib.import_module("dbdnet_jax").__all__:
        assert f'id="dbdnet_jax.{name}"' in api, f"{name} is missing in docs/api.md"


@pytest.mark.parametrize("link", ["[a](none.md)", "[a](index.md#none)"])
def test_a_broken_link_is_caught(tmp_path, link):
    pytest.importorskip("furo", reason="the docs extra (Sphinx, MyST, furo) is not installed")
    (tmp_path / "conf.py").write_text((ROOT / "docs" / "conf.py").read_text())
    (tmp_path / "index.md").write_text(f"# A\n\n{link}\n")
    run = build(tmp_path, tmp_path / "site")
    assert "none" in run.stderr and run.returncode != 0


def test_the_notebook_runs_and_is_stored_without_output(monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="the test extra's nbclient is not installed")
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    folder = {"metadata": {"path": str(NOTEBOOK.parent)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=folder).execute()
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.get("name") == "stderr" for output in outputs), outputs
