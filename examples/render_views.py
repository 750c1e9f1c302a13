"""A mesh drawn from all sides, and in one given pose: `python examples/render_views.py [FOLDER]`."""

import sys
from pathlib import Path

import numpy as np

from posekit import Camera, Pose, Renderer
from posekit.geometry import euler_xyz
from posekit.render import render_views, view_rotations
from posekit.synth.example import locomotive
from posekit.visualise import draw

out = Path(sys.argv[1] if len(sys.argv) > 1 else "posekit-out/render_views")
out.mkdir(parents=True, exist_ok=True)
model = locomotive()  # or ObjectModel.load("part.ply", units="mm")
renderer = Renderer(samples=4)  # smooth edges

views = render_views(renderer, model, view_rotations(12), (320, 240))
sheet = draw.grid([view.image for view in views], captions=[str(k) for k in range(len(views))])
(out / "sheet.png").write_bytes(draw.png(sheet))

# One pose through one camera. A View is an image with its camera, here also with mask, depth and object coordinates.
camera = Camera(fx=610, fy=610, cx=319.5, cy=239.5, width=640, height=480)
T_cam_obj = Pose(euler_xyz(np.deg2rad([110, 0, 30])), np.array([0.0, 0.02, 0.4]))  # metres
[view] = renderer.render(model, [T_cam_obj], camera)
assert view.mask is not None and view.depth is not None and view.coords is not None
(out / "pose.png").write_bytes(draw.png(view.image))
(out / "mask.png").write_bytes(draw.png(view.mask))
nearest = view.depth[view.mask].min()
print(f"{view.mask.sum()} pixels show the object, the nearest {nearest:.3f} m away; its origin is seen at")
print(camera.project(T_cam_obj.t).round(1))
print(f"look at {out / 'sheet.png'} and {out / 'pose.png'}")
