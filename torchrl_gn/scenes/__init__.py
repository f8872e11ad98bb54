"""Physical scenes as graphs, read from MuJoCo models.

Example:
    >>> from torchrl_gn.scenes import load_scene
    >>> scene = load_scene("swimmer6")
    >>> scene.num_nodes, scene.num_edges, scene.num_actions
    (7, 16, 5)
"""

from torchrl_gn.scenes.articulation import Articulation as Articulation
from torchrl_gn.scenes.articulation import require_bodies as require_bodies
from torchrl_gn.scenes.files import MissingMeshWarning as MissingMeshWarning
from torchrl_gn.scenes.kinematic_tree import KinematicTree as KinematicTree
from torchrl_gn.scenes.kinematic_tree import tree_states as tree_states
from torchrl_gn.scenes.load import load_scene as load_scene
from torchrl_gn.scenes.load import scene_from_description as scene_from_description
from torchrl_gn.scenes.observation_graph import ObservationGraph as ObservationGraph
from torchrl_gn.scenes.physical_parameters import ParameterNames as ParameterNames
from torchrl_gn.scenes.physical_parameters import PhysicalParameters as PhysicalParameters
from torchrl_gn.scenes.scaled import with_factors as with_factors
from torchrl_gn.scenes.scene import Attachment as Attachment
from torchrl_gn.scenes.scene import Scene as Scene
from torchrl_gn.scenes.scene import SceneChangedWarning as SceneChangedWarning
from torchrl_gn.scenes.scene import SceneError as SceneError
from torchrl_gn.scenes.scene import StaticGraph as StaticGraph
from torchrl_gn.scenes.scene import UnsupportedSceneError as UnsupportedSceneError
from torchrl_gn.scenes.suite_tasks import has_target as has_target
from torchrl_gn.scenes.suite_tasks import hidden_by_task as hidden_by_task
from torchrl_gn.scenes.suite_tasks import load_suite_task as load_suite_task
from torchrl_gn.scenes.suite_tasks import suite_name as suite_name
from torchrl_gn.scenes.systems import SYSTEMS as SYSTEMS
from torchrl_gn.scenes.systems import ParameterRange as ParameterRange
from torchrl_gn.scenes.variants import has_variants as has_variants
from torchrl_gn.scenes.variants import make_variants as make_variants
from torchrl_gn.scenes.variants import parameter_ranges as parameter_ranges
from torchrl_gn.scenes.variants import sample_parameters as sample_parameters
from torchrl_gn.scenes.variants import sample_variants as sample_variants
