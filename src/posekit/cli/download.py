"""``posekit download``: a BOP data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def download(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="Name of the data set: lmo, lm, linemod, ycbv, tless, tudl, icbin, itodd, hb, ..."
        ),
    ],
    root: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder that holds all data sets. Default: $POSEKIT_DATA, else ~/.cache/posekit/data."
        ),
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the archives after they are unpacked.")] = False,
) -> None:
    """Fetch a data set in BOP layout; a download that was interrupted is resumed."""
    from posekit.datasets.download import download as fetch
    from posekit.datasets.registry import data_folder, dataset_info

    info = dataset_info(name)
    folder = data_folder() if root is None else root
    typer.echo(f"{info.title}: {', '.join(info.archives)} into {folder / info.below}")
    fetched = fetch(info, folder, keep=keep)
    new = f"fetched {', '.join(fetched.archives)}" if fetched.archives else "all archives were there"
    typer.echo(f"{fetched.folder}: {new}")
