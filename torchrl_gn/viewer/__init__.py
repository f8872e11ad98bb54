"""A page in the browser that shows a scene and a model's prediction beside MuJoCo's simulation."""

from torchrl_gn.viewer.app import Viewer as Viewer
from torchrl_gn.viewer.recordings import Recording as Recording
from torchrl_gn.viewer.recordings import read_recording as read_recording
from torchrl_gn.viewer.serve import serve as serve
from torchrl_gn.viewer.sources import load_policy as load_policy
from torchrl_gn.viewer.sources import load_source as load_source
