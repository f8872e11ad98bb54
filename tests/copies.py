"""Recipes in copies of a process that has imported them all, which takes longer than what most tests have them do.

A copy is a recipe as a user starts it, but for Hydra's command line. Recipes that it starts are copies too.
"""

from __future__ import annotations

import atexit
import importlib.util
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from multiprocessing import resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any

RECIPES = Path(__file__).parents[1] / "recipes"
PLACES = (RECIPES, RECIPES / "benchmarks")
NAMES = sorted(str(path.relative_to(RECIPES).with_suffix("")) for place in PLACES for path in place.glob("[!_]*.py"))
sys.path.extend(map(str, PLACES))  # as Python does for a script, which imports what lies beside it
OUTSIDE = "interrupted outside of the recipe"


def load(recipe: str) -> ModuleType:
    """Import a recipe by name, once, and return its module."""
    if (name := f"recipe_{recipe}") in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{recipe}.py")
    assert spec is not None and spec.loader is not None
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compose(recipe: str, options: Sequence[str] = ()) -> Any:
    """A recipe's configuration, with options."""
    import hydra

    with hydra.initialize_config_dir(str((RECIPES / recipe).parent / "config"), version_base=None):
        return hydra.compose(Path(recipe).name, overrides=list(options))


def import_all() -> None:
    """Import all recipes, to be copied from then on, also when others start them."""
    import matplotlib.backends.backend_agg  # noqa: F401

    for recipe in NAMES:
        load(recipe)
    from _common import parent, sweeps

    start_program = parent.start_child

    def start_child(command: Sequence[str], **options: Any) -> _Copy | subprocess.Popen:
        return (_Copy if Path(command[1]).parent == RECIPES else start_program)(command, **options)

    parent.start_child = sweeps.start_child = start_child  # type: ignore
    assert os.listdir("/proc/self/task") == [str(os.getpid())], "copies of a process have one of its threads alone"


def run(recipe: str, options: Sequence[str]) -> int:
    """Call a recipe's main function as its process would; return the exit code."""
    from hydra.core.global_hydra import GlobalHydra
    from tqdm import tqdm

    sys.argv = [str(RECIPES / f"{recipe}.py"), *options]
    tqdm.set_lock(threading.RLock())  # not one of all copies, which one that is killed could keep
    GlobalHydra.instance().clear()  # of the recipe that started this one
    code = 0
    try:
        # Shells let what they start in the background ignore Ctrl-C.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        load(recipe).main(compose(recipe, options))
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except KeyboardInterrupt:
        sys.stderr.write(f"{OUTSIDE}\n")
        code = 130
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return code


class _Copy:
    """A recipe that another one starts, for ``subprocess.Popen``."""

    def __init__(self, command: Sequence[str], *, stdout: Any, stderr: Any, cwd: Path, start_new_session: bool) -> None:
        from _common import parent

        ours, theirs = os.pipe()
        sys.stdout.flush()  # what waits there is not the copy's
        self.number = os.fork()
        if not self.number:
            if start_new_session:
                os.setsid()
            os.dup2(ours, 0)
            os.dup2(stdout.fileno(), 1)
            os.dup2(stderr.fileno(), 2)
            os.closerange(3, 1000)  # other children's pipes, and locks of run folders
            resource_tracker._resource_tracker.__init__()  # its pipe, too
            os.environ[parent._VARIABLE] = "1"
            os.chdir(cwd)
            code = run(Path(command[1]).stem, command[2:])
            atexit._run_exitfuncs()
            os._exit(code)
        os.close(ours)
        self.stdin = os.fdopen(theirs, "wb")
        self.returncode: int | None = None

    def wait(self) -> int:
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.number, 0)[1])
        return self.returncode

    def terminate(self) -> None:
        if self.returncode is None:
            os.kill(self.number, signal.SIGTERM)
