"""Physical scenes as graphs, read from MuJoCo models.

Example:
    >>> from torchrl_gn.scenes import load_scene
    >>> scene = load_scene("swimmer6")
    >>> scene.num_nodes, scene.num_edges, scene.num_actions
    (7, 16, 5)
"""

from torchrl_gn.scenes.errors import SceneChangedWarning, SceneError, UnsupportedSceneError
from torchrl_gn.scenes.kinematic_tree import KinematicTree, tree_states
from torchrl_gn.scenes.load import load_scene, scene_from_description
from torchrl_gn.scenes.observation_graph import ObservationGraph
from torchrl_gn.scenes.parameter_names import ParameterNames
from torchrl_gn.scenes.physical_parameters import PhysicalParameters
from torchrl_gn.scenes.scene import Attachment, Scene, StaticGraph
from torchrl_gn.scenes.systems import SYSTEMS, ParameterRange
from torchrl_gn.scenes.variants import has_variants, make_variants, parameter_ranges, sample_parameters, sample_variants

__all__ = [
    "SYSTEMS",
    "Attachment",
    "ParameterNames",
    "KinematicTree",
    "ObservationGraph",
    "ParameterRange",
    "Scene",
    "SceneChangedWarning",
    "SceneError",
    "PhysicalParameters",
    "StaticGraph",
    "UnsupportedSceneError",
    "tree_states",
    "has_variants",
    "load_scene",
    "make_variants",
    "parameter_ranges",
    "sample_parameters",
    "sample_variants",
    "scene_from_description",
]
