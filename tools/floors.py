"""Print every lower bound of pyproject.toml as a constraint that pins it.

    pip install -e ".[test]" -c <(python tools/floors.py) && pytest -m fast

Bounds that nobody installs are wishes: so two of this project's once could not be met together.
"""

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"


def floors(text: str) -> list[str]:
    """``name==bound`` for every requirement of a project file, extras included.

    Raises:
        ValueError: a requirement without a lower bound.
    """
    project = tomllib.loads(text)["project"]
    required = project["dependencies"] + sum(project["optional-dependencies"].values(), [])
    found = []
    for requirement in required:
        if requirement.startswith(project["name"]):
            continue  # an extra that holds another one
        parts = re.fullmatch(r"([\w.-]+)>=([\d.]+)", requirement)
        if parts is None:
            raise ValueError(f"a requirement must be NAME>=VERSION; got {requirement!r}.")
        found.append(f"{parts[1]}=={parts[2]}")
    return found


if __name__ == "__main__":
    print("\n".join(floors(PROJECT.read_text())))
