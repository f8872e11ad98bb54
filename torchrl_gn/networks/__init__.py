"""Graph networks: the GN block, and the cores built from it."""

from torchrl_gn.networks.core import Core as Core
from torchrl_gn.networks.core import FoldedCore as FoldedCore
from torchrl_gn.networks.core import ListedCore as ListedCore
from torchrl_gn.networks.core import UnfoldedCore as UnfoldedCore
from torchrl_gn.networks.cores import CORES as CORES
from torchrl_gn.networks.gn_block import GNBlock as GNBlock
from torchrl_gn.networks.gn_core import GNCore as GNCore
from torchrl_gn.networks.graph import Graph as Graph
from torchrl_gn.networks.graph import GraphSize as GraphSize
from torchrl_gn.networks.graph import graph_concat as graph_concat
from torchrl_gn.networks.graph import graph_split as graph_split
from torchrl_gn.networks.incidence import Incidence as Incidence
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP as LayerNormMLP
from torchrl_gn.networks.mlp_core import MLPCore as MLPCore
from torchrl_gn.networks.recurrent_core import RecurrentCore as RecurrentCore
