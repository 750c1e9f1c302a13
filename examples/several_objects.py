"""Several objects in one picture, with one set of networks: `python examples/several_objects.py [FOLDER]`."""

import sys
from pathlib import Path

import numpy as np

from posekit import Renderer, estimate
from posekit.estimate.estimator import Estimators
from posekit.synth.example import locomotive
from posekit.synth.tabletop import TabletopConfig, compose, procedural_objects
from posekit.visualise import draw, figures

out = Path(sys.argv[1] if len(sys.argv) > 1 else "posekit-out/several_objects")
out.mkdir(parents=True, exist_ok=True)

# A scene to try: the locomotive and random shapes on a table, drawn with a seed.
rng = np.random.default_rng(4)
renderer, shapes = Renderer(), procedural_objects(2, rng)
look = TabletopConfig(
    objects=(3, 3), distractors=(0, 0), pile=0.0, table=1.0, distance=(3.0, 3.5), elevation_deg=(35, 50), paint=0.0
)
scene = compose(renderer, [locomotive(), *shapes], look, rng)

# One estimator for each mesh; all share their networks, and are kept for the next picture.
estimators = Estimators()
found = []
for k, placed in enumerate(scene.placed):
    result = estimate(scene.view, estimators(placed.model), mask=scene.mask(k))  # or box=..., or neither
    print(f"{placed.model.name}: {result.best.verdict}")
    found.append((placed.model, result.best))

picture = figures.overlay(renderer, scene.view, found)
(out / "overlay.png").write_bytes(draw.png(picture))
print(f"look at {out / 'overlay.png'}")
