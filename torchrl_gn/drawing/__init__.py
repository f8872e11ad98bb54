"""Pictures of scenes, and the colours that figures share."""

from torchrl_gn.drawing.images import draw_states as draw_states
from torchrl_gn.drawing.images import scene_drawing as scene_drawing
