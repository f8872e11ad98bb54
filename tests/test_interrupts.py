"""Interrupts that wait: none is lost, none comes in the middle."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from torchrl_gn.interrupts import held, let_in_at_once


@pytest.fixture(autouse=True)
def handlers():
    """Ctrl-C as at a prompt, and SIGTERM as in recipes; as before after the test."""

    def ended(number: int, _) -> None:
        raise KeyboardInterrupt(number)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, ended)
    yield ended
    for number, handler in before.items():
        signal.signal(number, handler)


def press(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_comes_when_the_block_ends(number, handlers):
    whole = []
    with pytest.raises(KeyboardInterrupt), held() as interrupts:
        assert not interrupts.waiting
        press(number)
        press(number)
        assert interrupts.waiting
        whole.append(True)
    assert whole == [True]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is handlers
    with held():
        pass  # the second one asked for the same


def test_the_outermost_block_counts():
    done = []
    with pytest.raises(KeyboardInterrupt), held() as outer:
        with held() as inner:
            press()
            assert inner.waiting and not outer.waiting
            inner.let_in()
            assert outer.waiting and not inner.waiting
            press()
        done.append("inner")
    assert done == ["inner"]


def test_between_steps_it_is_let_in():
    steps = []
    with pytest.raises(KeyboardInterrupt), held() as interrupts:
        for step in range(5):
            steps.append(step)
            if step == 2:
                press()
            interrupts.let_in()
    assert steps == [0, 1, 2]


def test_what_can_be_given_up_is_interrupted_at_once_and_the_rest_is_not():
    done = []
    with pytest.raises(KeyboardInterrupt), held():
        with held():
            try:
                with let_in_at_once():
                    done.append("begun")
                    press()
                    done.append("never")
            finally:
                press()  # as while something is saved
                done.append("saved")
    assert done == ["begun", "saved"]
    with pytest.raises(KeyboardInterrupt), held():
        press()
        with let_in_at_once():  # it waited for this
            done.append("never")
    with let_in_at_once():
        pass
    assert done == ["begun", "saved"]


def test_an_error_counts_more_and_handlers_are_put_back(handlers):
    with pytest.raises(ValueError, match="disk"), held():
        press()
        raise ValueError("disk")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        press()


def test_ignored_signals_stay_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with held() as interrupts:
        press()
        assert not interrupts.waiting
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_other_threads_hold_nothing():
    seen = []

    def work() -> None:
        with held() as interrupts, let_in_at_once():
            interrupts.let_in()
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]


def test_a_process_without_handlers_ends_after_the_block():
    program = (
        "import os, signal, sys; sys.modules['torchrl_gn'] = type(sys)('torchrl_gn');"
        "import importlib.util as util; spec = util.spec_from_file_location('interrupts', sys.argv[1]);"
        "module = util.module_from_spec(spec); spec.loader.exec_module(module)\n"
        "with module.held():\n    os.kill(os.getpid(), signal.SIGTERM); print('whole', flush=True)\nprint('never')"
    )
    file = sys.modules[held.__module__].__file__
    done = subprocess.run([sys.executable, "-c", program, str(file)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (-signal.SIGTERM, "whole\n"), done.stderr
