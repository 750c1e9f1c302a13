"""An object followed through a video: `python examples/track_video.py [FOLDER] [FRAMES]`."""

import json
import sys
from pathlib import Path

from posekit import Renderer, estimate
from posekit.io.video import VideoWriter, open_frames
from posekit.synth.example import make_film
from posekit.tracking.tracker import Tracker
from posekit.visualise import figures

out = Path(sys.argv[1] if len(sys.argv) > 1 else "posekit-out/track_video")
out.mkdir(parents=True, exist_ok=True)

# A film to try: the locomotive turns on a table. Yours is a file, or a folder of pictures, or a camera's number.
film = list(make_film(Renderer(), int(sys.argv[2]) if len(sys.argv) > 2 else 60))
with VideoWriter(out / "film.mp4", rate=30) as writer:
    for example in film:
        writer.write(example.view.image)
model, camera, box = film[0].model, film[0].view.camera, film[0].box

tracker = None
with (out / "poses.jsonl").open("w") as poses, VideoWriter(out / "tracked.mp4", rate=30) as writer:
    for frame in open_frames(str(out / "film.mp4"), "610,610,322,236"):
        if frame.image is None:
            print(f"frame {frame.number}: {frame.problem}")
            continue
        if tracker is None:  # where it is in the first frame
            first = estimate(frame.image, model, box=box, camera=camera)
            print(f"first frame: {first.best.verdict}")
            tracker = Tracker(model, camera, pose=first.T_cam_obj, estimator=first.estimator)
        found = tracker.step(frame.image)
        pose, picture = found.T_cam_obj, frame.image
        if pose is not None:  # None: lost
            picture = figures.outlined(tracker.renderer, picture, camera, model, pose)
        matrix = None if pose is None else pose.matrix.tolist()
        poses.write(json.dumps({"frame": frame.number, "state": found.state, "T_cam_obj": matrix}) + "\n")
        writer.write(picture)
print(f"look at {out / 'tracked.mp4'}; a pose for each frame is in {out / 'poses.jsonl'}")
