"""Errors as the paper defines them, rollouts, figures and videos."""

from torchrl_gn.drawing.geometry import kinetic_energy as kinetic_energy
from torchrl_gn.evaluation.baselines import baseline_errors as baseline_errors
from torchrl_gn.evaluation.error_table import ErrorTable as ErrorTable
from torchrl_gn.evaluation.error_table import PredictionError as PredictionError
from torchrl_gn.evaluation.error_table import summary as summary
from torchrl_gn.evaluation.errors import evaluate_errors as evaluate_errors
from torchrl_gn.evaluation.errors import squared_errors as squared_errors
from torchrl_gn.evaluation.figures import plot_bars as plot_bars
from torchrl_gn.evaluation.figures import plot_errors as plot_errors
from torchrl_gn.evaluation.figures import plot_learning_curves as plot_learning_curves
from torchrl_gn.evaluation.figures import plot_loglog as plot_loglog
from torchrl_gn.evaluation.figures import plot_planning_curves as plot_planning_curves
from torchrl_gn.evaluation.figures import plot_rewards as plot_rewards
from torchrl_gn.evaluation.figures import plot_training_curve as plot_training_curve
from torchrl_gn.evaluation.motion_figures import plot_body_trajectory as plot_body_trajectory
from torchrl_gn.evaluation.motion_figures import plot_joints as plot_joints
from torchrl_gn.evaluation.motion_figures import plot_motions as plot_motions
from torchrl_gn.evaluation.report import fresh_errors as fresh_errors
from torchrl_gn.evaluation.report import identification_errors as identification_errors
from torchrl_gn.evaluation.report import linear_probe as linear_probe
from torchrl_gn.evaluation.report import report as report
from torchrl_gn.evaluation.rollout import GuardedRollout as GuardedRollout
from torchrl_gn.evaluation.rollout import guarded_rollout as guarded_rollout
from torchrl_gn.evaluation.rollout import rollout as rollout
from torchrl_gn.evaluation.video import rollout_frames as rollout_frames
from torchrl_gn.evaluation.video import rollout_video as rollout_video
