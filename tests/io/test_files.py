"""Whole files, and a cache that is never needed."""

import errno
import os
import warnings
from pathlib import Path

import pytest

from dbdnet_jax.io import files
from dbdnet_jax.io.files import cache_folder, machine_error, require_writable, warn_without_cache


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home of one's own, and nothing said yet."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    warn_without_cache.cache_clear()
    return tmp_path


def test_the_folder_is_private_whatever_the_umask(home):
    before = os.umask(0)
    try:
        folder = cache_folder("programs")
    finally:
        os.umask(before)
    assert folder == home / ".cache" / "dbdnet_jax" / "programs"
    assert {path.stat().st_mode & 0o777 for path in (folder, folder.parent)} == {0o700}
    assert cache_folder("programs") == folder


@pytest.mark.parametrize(("given", "used"), [("x", True), ("", False), ("relative", False)])
def test_xdg_cache_home_counts_where_it_is_absolute(home, monkeypatch, given, used):
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "x") if used else given)
    assert cache_folder("a") == home / ("x" if used else ".cache") / "dbdnet_jax" / "a"


def a_file(home, monkeypatch):
    (home / ".cache").write_text("a file")


def no_home(home, monkeypatch):
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", lambda uid: {}[uid])


def relative_home(home, monkeypatch):
    monkeypatch.setenv("HOME", "home")


def readable_by_none(home, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.mkdir", refuse)


def open_to_all(home, monkeypatch):
    cache_folder("programs").chmod(0o777)


def open_to_a_group(home, monkeypatch):
    cache_folder("programs").parent.chmod(0o770)


def of_another(home, monkeypatch):
    cache_folder("programs")
    monkeypatch.setattr("os.geteuid", lambda: 12345)


def in_a_folder_of_all(home, monkeypatch):
    (home / ".cache").mkdir()
    (home / ".cache").chmod(0o777)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (a_file, r"\.cache"),
        (no_home, "this user has no home folder"),
        (relative_home, "HOME must be an absolute path; got 'home'"),
        (readable_by_none, "Permission denied"),
        (open_to_all, "must be this user's alone; .* its mode 777"),
        (open_to_a_group, "must be this user's alone; .* its mode 770"),
        (of_another, "must be this user's alone; its owner is"),
        (in_a_folder_of_all, "must be this user's alone; .* its mode 777"),
    ],
)
def test_where_there_can_be_no_cache_it_is_said_once(home, monkeypatch, spoil, words):
    spoil(home, monkeypatch)
    with pytest.warns(RuntimeWarning, match=f"nothing is kept for the next run.*{words}"):
        assert cache_folder("programs") is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cache_folder("programs") is None


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    require_writable(tmp_path / "new" / "folder")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"the folder .*file/below must be one that files can be"):
        require_writable(tmp_path / "file" / "below")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space left on device. Choose another, or make room"):
        require_writable(tmp_path)


def test_a_name_of_full_length_is_written(tmp_path):
    files.write_atomic(tmp_path / ("n" * 255), b"x")
    assert (tmp_path / ("n" * 255)).read_bytes() == b"x"


@pytest.mark.parametrize(
    ("error", "number"),
    [
        (OSError(errno.ENOSPC, "full"), errno.ENOSPC),
        (PermissionError(errno.EACCES, "no"), errno.EACCES),
        (ValueError("Error writing: [OS error 28: ENOSPC No space left on device]"), errno.ENOSPC),
        (MemoryError(), errno.ENOMEM),
        (FileNotFoundError(errno.ENOENT, "gone"), None),
        (ValueError("[OS error 2: ENOENT No such file]"), None),
        (ValueError("not an NPZ"), None),
    ],
)
def test_an_error_of_the_machine_is_told_from_one_of_the_file(error, number):
    try:
        try:
            raise error
        except Exception as cause:
            raise RuntimeError("a library failed") from cause
    except RuntimeError as caught:
        found = machine_error(caught, Path("a/b"))
    assert (found and (found.errno, found.filename)) == (number and (number, "a/b"))
