"""System identification: the inference model, and numbers of a MuJoCo model."""

from torchrl_gn.identification.identify_parameters import Identified as Identified
from torchrl_gn.identification.identify_parameters import identify_parameters as identify_parameters
from torchrl_gn.identification.identify_parameters import parameter_names as parameter_names
from torchrl_gn.identification.identify_parameters import with_factors as with_factors
from torchrl_gn.identification.inference_model import BoundInferenceModel as BoundInferenceModel
from torchrl_gn.identification.inference_model import IdentifyingModel as IdentifyingModel
from torchrl_gn.identification.inference_model import InferenceModel as InferenceModel
