"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from posekit.errors import OutputError


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write a file under a temporary name beside it and move it into place. Raises OutputError where that fails."""
    temporary: str | None = None
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name[:100]}.", suffix=".part", dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
        Path(temporary).chmod(_mode(path))
        Path(temporary).replace(path)
    except BaseException as error:
        if temporary is not None:
            with suppress(OSError):
                Path(temporary).unlink()
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise OutputError(
                f"{path} cannot be written: {reason}. Name a folder that exists and is writable."
            ) from error
        raise


def read_text(path: Path) -> str:
    """A text file in UTF-8, or in what its byte order mark says; line ends become \\n. Raises OSError, and
    UnicodeDecodeError (a ValueError) where it is no such text."""
    return decoded(path.read_bytes()).replace("\r\n", "\n").replace("\r", "\n")


def decoded(data: bytes) -> str:
    """A text file's bytes as `read_text` decodes them; line ends stay. Raises UnicodeDecodeError."""
    wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")  # as PowerShell writes
    return data.decode("utf-16" if wide else "utf-8-sig")


def other_content(data: bytes) -> str | None:
    """What a file holds instead of what its name says, as the end of a sentence; None where nothing is known of it."""
    head = data[:300].lstrip().lower()
    if head.startswith(b"version https://git-lfs"):
        return "holds a pointer of Git LFS instead of the data: get them with git lfs pull"
    if head.startswith((b"<!doctype html", b"<html")):
        return "holds a web page instead of the data: download it again, and look whether a login or a link is needed"
    return None


def user_cache(name: str) -> Path:
    """The folder for what can be made anew: under XDG_CACHE_HOME, else ~/.cache. It need not exist."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "posekit" / name


def check_writable(folder: Path, trouble: str) -> None:
    """Whether a file can be made in a folder, or the folder in the nearest one that is there: by trying. Raises
    OutputError."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    try:
        if not there.is_dir():
            raise NotADirectoryError(20, f"{there} is a file")
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise OutputError(f"{trouble}: {error.strerror}. Choose another place, or change its permissions.") from error


def write_text_atomic(path: Path, text: str) -> None:
    """As `write_bytes_atomic`, UTF-8."""
    write_bytes_atomic(path, text.encode("utf-8"))


def _mode(path: Path) -> int:
    """The permissions of the file that is replaced, else the usual ones (a temporary file is private)."""
    with suppress(OSError):
        return path.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
