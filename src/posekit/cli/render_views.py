"""``posekit render-views``: a mesh from all sides."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from posekit.cli.options import ForceOption, JsonOption, ModelOption, UnitsOption, parse_size
from posekit.errors import ConfigError

_BATCH = 16  # views in memory at a time
_MOST_VIEWS = 10_000
_THUMBNAIL = 240  # pixels, longer side of a picture in the contact sheet


def render_views(
    model: ModelOption,
    views: Annotated[
        int,
        typer.Option(help="Number of views: 6 are along the axes, any other number is spread evenly over the sphere."),
    ] = 6,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the views, new or empty. Default: posekit-out/MESH-views, or posekit-out-2/MESH-views "
            "and so on.",
        ),
    ] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Width and height of each view, pixels.")] = "640x480",
    units: UnitsOption = "auto",
    force: ForceOption = False,
    json: JsonOption = None,
) -> None:
    """Render a mesh from all sides: RGB, masks, a contact sheet, and each view's camera and pose."""
    shape = parse_size(size)
    if not 1 <= views <= _MOST_VIEWS:
        raise ConfigError(f"--views {views}: from 1 to {_MOST_VIEWS} can be drawn.")

    from posekit.camera import Camera
    from posekit.cli.output import OutputFolder, check_json, write_json
    from posekit.mesh.model import ObjectModel
    from posekit.render import Renderer, centred_poses, render_views, view_rotations
    from posekit.render.views import DEFAULT_FOV
    from posekit.visualise import draw

    check_json(json)
    folder = OutputFolder.chosen(out, Path("posekit-out") / f"{model.stem}-views", force)
    mesh = ObjectModel.load(model, units=units)
    renderer = Renderer(samples=4)
    rotations, thumbnails = view_rotations(views), []
    for start in range(0, views, _BATCH):
        drawn = render_views(renderer, mesh, rotations[start : start + _BATCH], shape, coords=False)
        for k, view in enumerate(drawn, start):
            assert view.mask is not None
            folder.write(f"{k:04d}.png", draw.png(view.image))
            folder.write(f"{k:04d}_mask.png", draw.png(view.mask))
            thumbnails.append(draw.fit(view.image, _thumbnail_size(shape)))
    camera = Camera.from_fov(DEFAULT_FOV, *shape)
    entries = [
        {
            "image": f"{k:04d}.png",
            "mask": f"{k:04d}_mask.png",
            "T_cam_obj": pose.matrix.tolist(),
            "t_m": pose.t.tolist(),
            "quat_wxyz": pose.quat_wxyz.tolist(),
        }
        for k, pose in enumerate(centred_poses(mesh, rotations, camera))
    ]
    about = {"mesh": str(model), "camera": {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}}
    text = dumps({**about, "views": entries}, indent=1) + "\n"
    folder.write("views.json", text)
    sheet = draw.grid(thumbnails, captions=[str(k) for k in range(views)])
    typer.echo(f"{views} views and {folder.write('contact_sheet.png', draw.png(sheet))}", err=json == "-")
    write_json(json, text)


def _thumbnail_size(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, _THUMBNAIL / max(size))
    return max(1, round(scale * size[0])), max(1, round(scale * size[1]))
