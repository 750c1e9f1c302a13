"""``posekit cache``: what is kept on disk, and clearing it."""

from __future__ import annotations

from typing import Annotated

import typer


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Delete it; it is made again where it is needed.")] = False,
) -> None:
    """Show what is kept on disk to save time, how much, and where."""
    from posekit.io import cache_folder
    from posekit.io.files import user_cache

    folder = user_cache("")
    if clear:
        freed = cache_folder.clear()
        typer.echo(f"{_megabytes(freed)} deleted from {folder}")
        left = sum(each.size for each in cache_folder.kept())
        if left:
            typer.echo(f"{_megabytes(left)} could not be deleted: delete {folder} yourself.")
        return
    found = [each for each in cache_folder.kept() if each.count]
    if not found:
        typer.echo(f"nothing is kept in {folder}")
        return
    width = max(len(str(each.folder.relative_to(folder))) for each in found)
    for each in found:
        name = str(each.folder.relative_to(folder)).ljust(width)
        typer.echo(f"{name}  {each.count:4d}  {_megabytes(each.size):>9}  {each.what}")
    total = sum(each.size for each in found)
    typer.echo(f"{_megabytes(total)} in {folder}; posekit cache --clear deletes it")


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
