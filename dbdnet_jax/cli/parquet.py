"""Results as a Parquet file: a column for each number, and the lines of JSON they come from."""

import io
import json
from pathlib import Path
from types import ModuleType
from typing import Any

from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.io.files import write_atomic

PARQUET = ".parquet"
LINE = "record"  # the column of the lines, from which a batch goes on


def lines_file(path: Path) -> Path:
    """Where the lines are that are to come into a file of results, or are in it."""
    return path.with_name(f"{path.name}.jsonl") if path.suffix.lower() == PARQUET else path


def load_pyarrow() -> ModuleType:
    """Import pyarrow.

    Raises:
      MissingExtraError: it is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtraError(
            f"results in Parquet need pyarrow; importing it failed ({error}). Install it with "
            '`pip install "dbdnet_jax[parquet]"`, or name a file that ends in .jsonl.'
        ) from error
    return pyarrow


def read_lines(path: Path) -> list[bytes]:
    """The lines that `write_lines` wrote.

    Raises:
      ValueError: the file is damaged, or of somebody else.
      OSError: it cannot be opened.
    """
    pyarrow = load_pyarrow()
    data = path.read_bytes()
    try:
        lines = pyarrow.parquet.read_table(io.BytesIO(data), columns=[LINE])[LINE].to_pylist()
        return [line.encode() + b"\n" for line in lines]
    except (pyarrow.ArrowException, OSError, KeyError, AttributeError) as error:
        said = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise ValueError(
            f"results must be a Parquet file that an earlier run wrote; {path} is none, or damaged "
            f"({said}). Name another file."
        ) from error


def write_lines(path: Path, lines: list[bytes]) -> None:
    """Replace the file by one of these lines of JSON, whole or not at all."""
    pyarrow = load_pyarrow()
    records = [json.loads(line) for line in lines]
    names = dict.fromkeys(name for record in records for name in record)
    columns = {
        name: _column(pyarrow, [record.get(name) for record in records])
        for name in names
        if name not in ("options", LINE)
    }
    columns[LINE] = pyarrow.array([line.decode().rstrip("\n") for line in lines])
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(columns), buffer)
    write_atomic(path, buffer.getbuffer())


def _column(pyarrow: ModuleType, values: list[Any]) -> Any:
    """Typed values, or JSON where they are of several types."""
    try:
        return pyarrow.array(values)
    except pyarrow.ArrowException:
        return pyarrow.array([None if value is None else json.dumps(value) for value in values])
