"""BOP's data sets from their hub: with progress, resumed where it stopped, checked, unpacked."""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from posekit.datasets.registry import DatasetInfo
from posekit.errors import InputError, OutputError
from posekit.io.files import check_writable, write_text_atomic

OWNER = "bop-benchmark"
_DONE = ".posekit-download"
_BLOCK = 1 << 22


@dataclass(frozen=True)
class Fetched:
    """folder: the data set's. archives: those that were fetched now; the others were there."""

    folder: Path
    archives: tuple[str, ...]


def download(info: DatasetInfo, folder: Path, *, endpoint: str | None = None, keep: bool = False) -> Fetched:
    """Fetch and unpack a data set's archives into ``folder / info.below``.

    endpoint: of the hub; its own (or ``$HF_ENDPOINT``) where not given. keep: leave the archives in place.
    An interrupted download is resumed, finished archives are not fetched again. Each archive's SHA-256
    is compared with the one that the hub states.
    Raises InputError where the hub cannot be reached or a file is damaged, OutputError where it cannot be written.
    """
    if not info.archives:
        raise InputError(
            f"where {info.title} is to be had is not known: get it by hand and give its folder to posekit eval."
        )
    target = folder / info.below
    archives = folder / ".archives" / info.below
    for place in (target, archives):
        check_writable(place, f"the folder {place} cannot be written")
    try:
        target.mkdir(parents=True, exist_ok=True)
        archives.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"the folder {target} cannot be made: {error.strerror}. Choose another (--root DIR)."
        ) from error
    fetched = []
    for name in info.archives:
        marker = target / f"{_DONE}-{name}"
        if marker.is_file():
            continue
        path, digest = _fetch(f"{OWNER}/{info.below}", name, archives, endpoint)
        _unpack(path, target, info.below)
        write_text_atomic(marker, digest + "\n")
        fetched.append(name)
        if not keep:
            path.unlink()
    if not keep:
        shutil.rmtree(archives, ignore_errors=True)
    return Fetched(target, tuple(fetched))


def _fetch(repository: str, name: str, folder: Path, endpoint: str | None) -> tuple[Path, str]:
    """The archive and its SHA-256."""
    from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    try:
        url = hf_hub_url(repository, name, repo_type="dataset", endpoint=endpoint)
        stated = get_hf_file_metadata(url, endpoint=endpoint).etag
        path = Path(hf_hub_download(repository, name, repo_type="dataset", local_dir=folder, endpoint=endpoint))
    except (HfHubHTTPError, LocalEntryNotFoundError, OSError) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(
            f"{name} of {repository} could not be fetched: {first} What was fetched is kept: run the command again; "
            "or get it by hand and give its folder to posekit eval."
        ) from error
    digest = _sha256(path)
    if stated is not None and re.fullmatch(r"[0-9a-f]{64}", stated) and digest != stated:
        path.unlink()
        raise InputError(f"{name} is damaged: its SHA-256 is {digest}, the hub states {stated}. Run the command again.")
    return path, digest


def _sha256(path: Path) -> str:
    hasher = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            hasher.update(block)
    return hasher.hexdigest()


def _unpack(path: Path, target: Path, name: str) -> None:
    """Unpack beside the target, then move into place; a folder of the data set's own name at the top is left out."""
    with tempfile.TemporaryDirectory(prefix=".unpack-", dir=target) as place:
        try:
            with zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    parts = PurePosixPath(member.filename).parts
                    if PurePosixPath(member.filename).is_absolute() or ".." in parts:
                        raise InputError(f"{path.name} holds the path {member.filename!r}, which leads out of it.")
                archive.extractall(place)
        except (zipfile.BadZipFile, EOFError) as error:
            path.unlink()
            raise InputError(f"{path.name} is no ZIP archive ({error}). Run the command again.") from error
        except OSError as error:
            raise OutputError(f"{path.name} cannot be unpacked into {target}: {error.strerror}.") from error
        top = Path(place)
        inner = top / name
        _merge(inner if inner.is_dir() and len(list(top.iterdir())) == 1 else top, target)


def _merge(source: Path, target: Path) -> None:
    """Move all files into a folder that may hold others."""
    for path in sorted(source.rglob("*")):
        place = target / path.relative_to(source)
        if path.is_dir():
            place.mkdir(parents=True, exist_ok=True)
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            path.replace(place)
