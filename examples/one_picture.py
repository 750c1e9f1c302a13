"""The pose of one object in one picture: `python examples/one_picture.py [FOLDER]`."""

import sys
from pathlib import Path

from posekit import Renderer, estimate
from posekit.synth.example import make_example, ply
from posekit.visualise import draw

out = Path(sys.argv[1] if len(sys.argv) > 1 else "posekit-out/one_picture")
out.mkdir(parents=True, exist_ok=True)

# A photograph and a mesh to try; yours are files already.
example = make_example(Renderer())
(out / "photo.png").write_bytes(draw.png(example.view.image))
(out / "part.ply").write_text(ply(example.model))

# The box says where the object is (x0, y0, x1, y1, pixels); the camera is fx, fy, cx, cy.
result = estimate(out / "photo.png", out / "part.ply", box=(251, 139, 456, 294), camera="610,610,322,236", units="m")
print(result.best.verdict)
print(result.T_cam_obj.matrix.round(4))  # 4x4, metres, from the mesh's frame to OpenCV's camera frame
result.save(out)  # result.json and overlay.png
print(f"look at {out / 'overlay.png'}")
if not result.reliable:
    sys.exit(3)
