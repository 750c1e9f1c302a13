"""Drawing meshes: off-screen OpenGL, exact to the pixel convention."""

from posekit.render.context import info
from posekit.render.light import Light
from posekit.render.renderer import Renderer
from posekit.render.views import centred_poses, fit_distance, render_views, view_rotations

__all__ = ["Light", "Renderer", "centred_poses", "fit_distance", "info", "render_views", "view_rotations"]
