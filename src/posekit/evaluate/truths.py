"""What is to be found in a picture: instances with visible masks, which are rendered where the data set has none."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, mask_box
from posekit.datasets.bop import Instance
from posekit.datasets.registry import Dataset
from posekit.evaluate.options import EvalOptions
from posekit.render import Renderer

log = logging.getLogger("posekit")

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Truth:
    """An instance with all that a stage needs. visible: share in [0, 1]. box_visib, box_all: edges; None where
    nothing is seen of it. source: of the mask, "data set" or "rendered"."""

    instance: Instance
    visible: float
    box_visib: Box | None
    box_all: Box | None
    source: str
    read_mask: Callable[[], Mask]


class TruthReader:
    """Reads the truths of pictures. renderer: made when a mask has to be rendered for the first time."""

    def __init__(self, data: Dataset, make_renderer: Callable[[], Renderer] = Renderer) -> None:
        self.data, self._make = data, make_renderer
        self._renderer: Renderer | None = None
        self._told: set[int] = set()

    def instances(self, scene: int, image: int) -> list[Instance]:
        """All annotated instances of a picture whose objects have a mesh; the others are told, once for an object."""
        found, meshes = self.data.instances(scene, image, every=True), self.data.model_ids()
        for obj_id in sorted({i.obj_id for i in found} - {*meshes} - self._told):
            self._told.add(obj_id)
            log.warning(
                "scene %d, image %d: object %d has no mesh and is left out, here and in all other pictures; there are "
                "meshes of %s.",
                scene, image, obj_id, ", ".join(map(str, meshes)),
            )  # fmt: skip
        return [i for i in found if i.obj_id in meshes]

    def read(self, scene: int, image: int, masks: bool = True) -> list[Truth]:
        """All annotated instances of a picture whose objects have a mesh. masks: whether masks will be asked for;
        without, and where the boxes and visible shares are known, nothing is rendered."""
        instances = self.instances(scene, image)
        known = all(np.isfinite(i.visib_fract) for i in instances)
        there = all(i.mask_path.is_file() for i in instances)
        if known and (there or not masks):
            return [Truth(i, i.visib_fract, i.box_visib, i.box_obj, "data set", i.mask) for i in instances]
        rendered = self._rendered(scene, image, instances)
        return [self._completed(i, *drawn) for i, drawn in zip(instances, rendered, strict=True)]

    def _completed(self, instance: Instance, visible: Mask, whole: Mask) -> Truth:
        """The data set's own values where it has them, rendered ones elsewhere."""
        here = instance.mask_path.is_file()
        mask = instance.mask() if here else visible
        known = np.isfinite(instance.visib_fract)
        share = instance.visib_fract if known else float(mask.sum() / max(1, whole.sum()))
        return Truth(
            instance,
            min(1.0, share),
            instance.box_visib if known else mask_box(mask),
            instance.box_obj if known else mask_box(whole),
            "data set" if here else "rendered",
            lambda: mask,
        )

    def _rendered(self, scene: int, image: int, instances: list[Instance]) -> list[tuple[Mask, Mask]]:
        """For each instance its visible and its whole silhouette, from all annotated objects' depths."""
        if self._renderer is None:
            self._renderer = self._make()
        camera = self.data.camera(scene, image, self.data.picture_size(scene, image))
        depths = []
        for i in instances:
            [drawn] = self._renderer.render(self.data.model(i.obj_id), [i.T_cam_obj], camera, rgb=False)
            assert drawn.depth is not None
            depths.append(np.where(drawn.depth > 0, drawn.depth, np.inf))
        nearest = np.min(depths, axis=0) if depths else None
        return [(np.isfinite(d) & (d <= nearest), np.isfinite(d)) for d in depths]


def selected(data: Dataset, truths: list[Truth], scene: int, image: int, options: EvalOptions) -> list[Truth]:
    """The truths that are asked for: the test's targets, or those visible enough; of the wanted objects."""
    if options.min_visible is None:
        wanted = {i.index for i in data.instances(scene, image)}
        chosen = [t for t in truths if t.instance.index in wanted]
    else:
        chosen = [t for t in truths if t.visible >= options.min_visible]
    return [t for t in chosen if not options.objects or t.instance.obj_id in options.objects]


def pictures(data: Dataset, options: EvalOptions) -> list[tuple[int, int]]:
    """(scene, image) of the wanted pictures, in order. Raises ConfigError through the caller where none is left."""
    every = data.images()
    if options.images:
        every = [p for p in every if p in set(options.images)]
    if options.limit is not None and options.limit < len(every):
        every = [every[k] for k in np.linspace(0, len(every) - 1, options.limit).round().astype(int)]
    return every
