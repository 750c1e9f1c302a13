"""Scenes of many objects with occlusion, on tables and in heaps: for detectors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from posekit.datasets.bop_writer import Annotation, Picture
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.backdrops import Backdrops, photograph
from posekit.synth.draw_objects import Placed, annotate
from posekit.synth.plan import SynthConfig
from posekit.synth.tabletop import DISTRACTOR, Tabletop, TabletopConfig, compose, procedural_objects

OBJECTS = (3, 12)  # least and most in a scene
DISTRACTORS = 24  # procedural things to choose the others from
PHOTOS = 4  # backdrops that a scene's table and background are cut from


class Tables:
    """Image n is a scene of its own, composed as the detector's training composes them (`tabletop`)."""

    def __init__(self, config: SynthConfig, models: Mapping[int, ObjectModel], renderer: Renderer) -> None:
        self.config, self.models, self.renderer = config, sorted(models.items()), renderer
        self.backdrops = Backdrops(config.backgrounds, config.seed)
        unit = float(np.median([model.diameter for model in models.values()]))
        self.distractors = procedural_objects(DISTRACTORS, np.random.default_rng([config.seed, 3]), unit=unit)
        self.tabletop = TabletopConfig(size=config.size, objects=OBJECTS)

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """(place, picture) for each place, from block ``number``'s own random numbers."""
        for place in places:
            yield place, self._picture(np.random.default_rng([self.config.seed, 0, number]))

    def _picture(self, rng: np.random.Generator) -> Picture:
        photos = [self.backdrops.draw(rng, self.config.size) for _ in range(PHOTOS if self.backdrops.paths else 0)]
        models = [model for _, model in self.models]
        scene = compose(self.renderer, models, self.tabletop, rng, distractors=self.distractors, photos=photos)
        return Picture(photograph(scene.view.image, rng), scene.view.camera, self._annotations(scene), scene.view.depth)

    def _annotations(self, scene: Tabletop) -> list[Annotation]:
        return [
            annotate(self.renderer, Placed(self.models[p.number][0], p.model, p.T_cam_obj), scene.view.camera,
                     scene.mask(k))
            for k, p in enumerate(scene.placed) if p.number != DISTRACTOR
        ]  # fmt: skip
