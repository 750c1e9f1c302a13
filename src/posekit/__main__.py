"""``python -m posekit`` is ``posekit``."""

from posekit.cli.app import main

main()
