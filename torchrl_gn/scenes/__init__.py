"""Physical scenes as graphs, read from MuJoCo models.

Example:
    >>> from torchrl_gn.scenes import load_scene
    >>> scene = load_scene("swimmer6")
    >>> scene.num_nodes, scene.num_edges, scene.num_actions
    (7, 16, 5)
"""

from torchrl_gn.scenes.errors import SceneChangedWarning, SceneError, UnsupportedSceneError
from torchrl_gn.scenes.feature_set import FeatureSet
from torchrl_gn.scenes.joint_chain import JointChain, chain_states
from torchrl_gn.scenes.load import load_scene, scene_from_description
from torchrl_gn.scenes.observation_graph import ObservationGraph
from torchrl_gn.scenes.scene import Attachment, Scene, StaticGraph
from torchrl_gn.scenes.scene_values import SceneValues
from torchrl_gn.scenes.systems import SYSTEMS, ParameterRange
from torchrl_gn.scenes.variants import has_variants, make_variants, parameter_ranges, sample_parameters, sample_variants

__all__ = [
    "SYSTEMS",
    "Attachment",
    "FeatureSet",
    "JointChain",
    "ObservationGraph",
    "ParameterRange",
    "Scene",
    "SceneChangedWarning",
    "SceneError",
    "SceneValues",
    "StaticGraph",
    "UnsupportedSceneError",
    "chain_states",
    "has_variants",
    "load_scene",
    "make_variants",
    "parameter_ranges",
    "sample_parameters",
    "sample_variants",
    "scene_from_description",
]
