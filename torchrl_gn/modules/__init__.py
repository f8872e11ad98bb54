"""Graph networks, state maths and forward models."""

from torchrl_gn.modules.ablated_core import AblatedCore as AblatedCore
from torchrl_gn.modules.bound_forward_model import BoundForwardModel as BoundForwardModel
from torchrl_gn.modules.bound_forward_model import UnseenFeatureWarning as UnseenFeatureWarning
from torchrl_gn.modules.bound_recurrent_model import BoundRecurrentModel as BoundRecurrentModel
from torchrl_gn.modules.core import GNCore as GNCore
from torchrl_gn.modules.forward_model import FeatureSet as FeatureSet
from torchrl_gn.modules.forward_model import ForwardModel as ForwardModel
from torchrl_gn.modules.gn_block import GNBlock as GNBlock
from torchrl_gn.modules.graph import Graph as Graph
from torchrl_gn.modules.graph import GraphSize as GraphSize
from torchrl_gn.modules.graph import graph_concat as graph_concat
from torchrl_gn.modules.graph import graph_split as graph_split
from torchrl_gn.modules.inference_model import BoundInferenceModel as BoundInferenceModel
from torchrl_gn.modules.inference_model import IdentifyingModel as IdentifyingModel
from torchrl_gn.modules.inference_model import InferenceModel as InferenceModel
from torchrl_gn.modules.mlp_core import MLPCore as MLPCore
from torchrl_gn.modules.normalizer import Normalizer as Normalizer
from torchrl_gn.modules.precision import fast_matmul as fast_matmul
from torchrl_gn.modules.recurrent_core import RecurrentCore as RecurrentCore
from torchrl_gn.modules.specialized_model import SpecializedForwardModel as SpecializedForwardModel
from torchrl_gn.modules.specialized_model import specialize as specialize
from torchrl_gn.modules.state_layout import BODY_STATE as BODY_STATE
from torchrl_gn.modules.state_layout import Component as Component
from torchrl_gn.modules.state_layout import StateLayout as StateLayout
from torchrl_gn.modules.state_layout import joint_layout as joint_layout
