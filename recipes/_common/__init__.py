"""Code that recipes share, imported as ``_common``: Python looks for modules beside the script that it runs.

The import registers the core ``"ablated"``, which the ablation study's checkpoints name.
"""

from _common.ablated_core import AblatedCore as AblatedCore
from _common.command_line import clean_exit as clean_exit
from _common.command_line import with_help as with_help
from _common.inputs import keep_inputs as keep_inputs
from _common.options import as_list as as_list
from _common.options import chosen_names as chosen_names
from _common.options import load_system as load_system
from _common.options import refuse_without_effect as refuse_without_effect
from _common.options import scene_options as scene_options
from _common.run import finish_run as finish_run
from _common.run import open_log as open_log
from _common.run import open_run as open_run
from _common.run import read_config as read_config
from _common.run import refuse_other_options as refuse_other_options
from _common.run import resumed_checkpoint as resumed_checkpoint
from _common.run import say_trained as say_trained
