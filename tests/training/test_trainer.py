"""The training loop: it learns, stops when it should, and resumes bit for bit."""

from __future__ import annotations

import copy
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torchrl.data import ReplayBuffer

from torchrl_gn.dynamics.executors.native.build import find_compiler
from torchrl_gn.dynamics.executors.native.preparation import preparation
from torchrl_gn.maths import fast_matmul
from torchrl_gn.processor import native_threads, onednn_precision
from torchrl_gn.training import Budget, Trainer, Workers, load_pretrained, save_checkpoint
from torchrl_gn.training.nested_state import flatten


def weights(trainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.model.state_dict().items()}


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["muon", "adam"])
def test_the_loss_falls(make_trainer, preset):
    trainer = make_trainer(Budget(steps=200), preset=preset, noise=0.0)
    losses = [progress.loss for progress in trainer.run()]
    assert len(losses) == 200
    assert sum(losses[-20:]) < (0.3 if preset == "muon" else 0.7) * sum(losses[:20])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_trains_the_same_and_its_checkpoint_goes_on_anywhere(make_trainer, tmp_path):
    losses = {}
    for device in ("cpu", "cuda"):
        trainer = make_trainer(Budget(steps=10), preset="adam", unroll=0.5, device=device)
        losses[device] = [progress.loss for progress in trainer.run()]
    torch.testing.assert_close(losses["cuda"], losses["cpu"], rtol=1e-3, atol=0)
    save_checkpoint(tmp_path / "checkpoint.safetensors", trainer.model, training=trainer.state_dict())
    saved = load_pretrained(tmp_path / "checkpoint.safetensors")
    again = make_trainer(Budget(steps=12), saved.model, preset="adam", unroll=0.5)
    again.load_state_dict(saved.training)
    assert len(list(again.run())) == 2


def test_progress_counts_steps_seconds_and_the_budget(make_trainer):
    progress = list(make_trainer(Budget(steps=8)).run())
    assert [p.step for p in progress] == list(range(1, 9))
    assert [p.fraction for p in progress] == [step / 8 for step in range(1, 9)]
    seconds = [p.seconds for p in progress]
    assert seconds == sorted(seconds) and seconds[0] > 0
    assert all(p.validation is None for p in progress)


def test_a_budget_of_minutes_ends_by_time(make_trainer):
    trainer = make_trainer(Budget(minutes=0.2 / 60))
    last = list(trainer.run())[-1]
    assert last.fraction == 1 and last.seconds >= 0.2
    trainer.seconds = 0.0  # as good as a larger budget: it goes on
    assert next(trainer.run()).step == last.step + 1


def test_the_processors_clock_stands_still_while_others_work(make_trainer):
    trainer = make_trainer(Budget(minutes=0.2 / 60, clock="processor"))
    started = time.process_time()
    for _ in trainer.run():
        time.sleep(0.01)  # takes no time of the processor
    assert 0.2 <= trainer.seconds <= time.process_time() - started + 0.01
    with pytest.raises(ValueError, match=r"clock='sun' is not known; use one of \['wall', 'processor'\]"):
        Budget(steps=1, clock="sun")


@dataclass(frozen=True)
class Clocked(Budget):
    """A budget with a clock of one's own."""

    read: Callable[[], float] = time.perf_counter

    def now(self) -> float:
        return self.read()


def test_the_callers_time_counts(make_trainer):
    """Saving and logging between steps is part of the budget and of the share outside the model."""
    clock = itertools.count(step=1.0)
    trainer = make_trainer(Clocked(steps=3, read=lambda: next(clock)))
    for _ in trainer.run():
        next(clock)  # one second of the caller's own
    assert trainer.spent["caller"] > 0 and trainer.spent["sampling"] > 0
    share = trainer.outside_share()
    step = trainer.spent["sampling"] + trainer.spent["caller"] + trainer.spent["model"] + trainer.spent["optimizer"]
    assert share == pytest.approx((trainer.spent["sampling"] + trainer.spent["caller"]) / step)
    assert 0 < share < 1
    assert make_trainer(Budget(steps=3)).outside_share() == 0


def test_preparing_steps_for_c_plus_plus_takes_nothing_of_the_budget(make_trainer):
    clock = [0.0]

    def validate() -> float:
        with preparation(3):
            clock[0] += 1000.0
        clock[0] += 2.0
        return 1.0

    trainer = make_trainer(Clocked(minutes=0.1, read=lambda: clock[0]), validate=validate, validations=2)
    for _ in trainer.run():
        clock[0] += 1.0
    assert trainer.spent == {"sampling": 0, "model": 0, "optimizer": 0, "validation": 2 * 2, "caller": trainer.step}
    assert trainer.step == 5 and trainer.seconds == 9.0


class Errors:
    """Validation errors given in advance, counting how often it was asked."""

    def __init__(self, *errors: float) -> None:
        self.errors, self.asked = errors, 0

    def __call__(self) -> float:
        self.asked += 1
        return self.errors[self.asked - 1]


def test_the_best_weights_are_kept(make_trainer):
    trainer = make_trainer(Budget(steps=12), validate=Errors(3.0, 1.0, 2.0, math.nan), validations=4)
    seen = {p.step: (p.validation, weights(trainer)) for p in trainer.run() if p.validation is not None}
    assert list(seen) == [3, 6, 9, 12]
    assert trainer.best == 1.0
    assert not all(torch.equal(value, seen[12][1][name]) for name, value in seen[6][1].items())
    trainer.restore_best()
    assert_same(weights(trainer), seen[6][1])


def test_without_validation_nothing_is_restored(make_trainer):
    trainer = make_trainer(Budget(steps=3))
    for _ in trainer.run():
        pass
    before = weights(trainer)
    trainer.restore_best()
    assert_same(weights(trainer), before)


def test_patience_stops_after_validations_without_a_new_best(make_trainer):
    errors = Errors(5.0, 3.0, 4.0, 3.5, 1.0, 1.0)
    trainer = make_trainer(Budget(steps=12), validate=errors, validations=6, patience=2)
    assert [p.validation for p in trainer.run() if p.validation is not None] == [5.0, 3.0, 4.0, 3.5]
    assert trainer.step == 8
    assert list(trainer.run()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("owner", "name"), [(ReplayBuffer, "sample"), (torch.optim.Adam, "step"), (Errors, "__call__")]
)
def test_an_interrupt_waits_until_the_step_is_whole(make_trainer, ctrl_c, owner, name):
    def trainer():
        return make_trainer(Budget(steps=8), preset="muon", validate=Errors(*range(8)), validations=8)

    whole, interrupted = trainer(), trainer()
    list(whole.run())
    ctrl_c(owner, name, 3)
    with pytest.raises(KeyboardInterrupt):
        list(interrupted.run())
    assert interrupted.step == interrupted.validated == 3
    list(interrupted.run())
    assert interrupted.step == 8
    assert_same(weights(interrupted), weights(whole))


@pytest.mark.slow
@pytest.mark.parametrize("stop", [1, 4, 7])
@pytest.mark.parametrize("preset", ["muon", "paper"])
def test_resumed_training_is_the_uninterrupted_one(make_trainer, scene, tmp_path, stop, preset):
    """Weights, normalisers, optimisers, sampled batches, noise, unrolling and validation all go on."""

    def trainer(model=None):
        options = {"preset": preset, "unroll": 0.4, "validations": 5, "patience": 10}
        made = make_trainer(Budget(steps=10), model, **options)
        made.validate = lambda: float(sum(p.detach().abs().sum() for p in made.model.parameters()))
        return made

    whole = trainer()
    expected = {p.step: (p.loss, p.validation) for p in whole.run()}

    first = trainer()
    before = {p.step: (p.loss, p.validation) for p in itertools.islice(first.run(), stop)}
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, first.model, scene=scene, training=first.state_dict())
    for _ in first.run():  # what happens after saving does not matter
        pass

    loaded = load_pretrained(path)
    torch.manual_seed(123)
    resumed = trainer(loaded.model)
    resumed.load_state_dict(loaded.training)
    assert resumed.step == stop and resumed.seconds > 0
    after = {p.step: (p.loss, p.validation) for p in resumed.run()}

    assert before | after == expected
    assert_same(weights(resumed), weights(whole))
    assert_same(resumed.best_weights, whole.best_weights)
    assert (resumed.best, resumed.since_best, resumed.validated) == (
        whole.best,
        whole.since_best,
        whole.validated,
    )
    last, expected_last = resumed.optimizer.state_dict(), whole.optimizer.state_dict()
    for index in expected_last:
        rates = [[group["lr"] for group in state[index]["param_groups"]] for state in (last, expected_last)]
        assert rates[0] == rates[1]


@pytest.mark.parametrize("part", ["loss", "samplers", "optimizer", "progress"])
def test_a_state_that_is_refused_changes_nothing(make_trainer, part):
    """Half of it was loaded: the training that began then had the optimiser of another."""
    saved = make_trainer(Budget(steps=9), preset="adam")
    list(saved.run())
    wrong = copy.deepcopy(saved.state_dict())
    if part == "loss":
        wrong["loss"]["error_weight"] = torch.zeros(3)
    elif part == "samplers":
        wrong["samplers"]["main"]["generator"] = wrong["samplers"]["main"]["generator"].clone().fill_(255)[:7]
    elif part == "optimizer":
        next(iter(wrong["optimizer"]["0"]["state"].values()))["exp_avg"] = torch.zeros(1)
    else:
        wrong["progress"]["step"] = -1
    trainer, fresh = (make_trainer(Budget(steps=4), preset="adam") for _ in range(2))
    before = flatten(copy.deepcopy(trainer.state_dict()), "", tensors_before := {})
    with pytest.raises((ValueError, RuntimeError)):
        trainer.load_state_dict(wrong)
    assert flatten(trainer.state_dict(), "", tensors := {}) == before
    assert_same(tensors_before, tensors)
    assert [now.loss for now in trainer.run()] == [now.loss for now in fresh.run()]


def test_a_finished_training_with_a_larger_budget_is_validated_on(make_trainer):
    first = make_trainer(Budget(steps=8), validate=Errors(5.0, 4.0, 3.0, 2.0), validations=4)
    for _ in first.run():
        pass
    more = make_trainer(Budget(steps=16), first.model, validate=Errors(3.0, 1.0), validations=4)
    more.load_state_dict(first.state_dict())
    seen = {p.step: p.validation for p in more.run() if p.validation is not None}
    assert seen == {12: 3.0, 16: 1.0}
    trained = weights(more)
    more.restore_best()
    assert_same(weights(more), trained)


def test_minutes_cap_a_budget_of_steps(make_trainer):
    trainer = make_trainer(Budget(steps=10**6, minutes=0.2 / 60))
    last = list(trainer.run())[-1]
    assert last.fraction == 1 and 0.2 <= last.seconds < 5 and trainer.cut_short
    done = make_trainer(Budget(steps=3, minutes=5))
    assert len(list(done.run())) == 3 and not done.cut_short


@pytest.mark.slow
def test_an_optimiser_of_torch_trains(make_trainer):
    trainer = make_trainer(Budget(steps=60), noise=0.0)
    trainer = Trainer(
        trainer.loss, trainer.buffer, torch.optim.AdamW(trainer.model.core.parameters(), lr=3e-3), trainer.budget
    )
    losses = [progress.loss for progress in trainer.run()]
    assert sum(losses[-10:]) < 0.7 * sum(losses[:10])
    assert trainer.optimizer.optimizers[0].param_groups[0]["lr"] == 3e-3
    saved = trainer.state_dict()
    trainer.load_state_dict(saved)
    assert trainer.step == 60


def test_an_optimiser_of_another_model_is_refused(make_trainer):
    """It would train nothing."""
    trainer, other = make_trainer(Budget(steps=1)), make_trainer(Budget(steps=1))
    for optimizer in (torch.optim.AdamW(other.model.parameters()), other.optimizer):
        with pytest.raises(ValueError, match="optimizer has no weight of the ForwardModel that is trained"):
            Trainer(trainer.loss, trainer.buffer, optimizer, trainer.budget)


def test_windows_are_unrolled_at_the_end(make_trainer):
    trainer = make_trainer(Budget(steps=10), unroll=0.3)
    shapes, inner = [], trainer.loss.forward
    trainer.loss.forward = lambda batch: shapes.append(tuple(batch.shape)) or inner(batch)
    for _ in trainer.run():
        pass
    assert shapes == [(32,)] * 7 + [(8, 3)] * 3


def test_costly_windows_get_fewer_steps_for_their_share(make_trainer):
    trainer = make_trainer(Budget(steps=17), unroll=0.2)
    trainer.unroll_cost = 4.0
    shapes, inner = [], trainer.loss.forward
    trainer.loss.forward = lambda batch: shapes.append(tuple(batch.shape)) or inner(batch)
    assert [progress.fraction for progress in trainer.run()][-1] == 1
    assert shapes == [(32,)] * 16 + [(8, 3)]
    with pytest.raises(ValueError, match="unroll_cost=0 must be positive"):
        Trainer(trainer.loss, trainer.buffer, trainer.optimizer, trainer.budget, unroll_cost=0)


def test_windows_whose_rollouts_diverge_are_drawn_anew(make_trainer):
    """One wild sample of a batch must not end a training; when all batches have some, it ends without a change."""
    trainer = make_trainer(Budget(steps=10), unroll=0.3)
    inner, drawn, bad = trainer.loss.forward, [], {0, 2, 3, 4}

    def diverging(batch):
        out = inner(batch)
        if batch.ndim > 1:
            drawn.append(len(drawn))
            if drawn[-1] in bad:
                out["loss_forward_model"] = out["loss_forward_model"] * math.inf
        return out

    trainer.loss.forward = diverging
    losses = [progress.loss for progress in trainer.run()]
    assert len(losses) == trainer.step == 10 and all(map(math.isfinite, losses)) and len(drawn) == 3 + len(bad)
    assert all(value.isfinite().all() for value in weights(trainer).values())
    trainer.budget, before = Budget(steps=11), weights(trainer)
    bad.update(range(100))
    with pytest.raises(FloatingPointError, match="loss is inf at step 10"):
        list(trainer.run())
    assert len(drawn) == 3 + 4 + 10
    assert_same(before, weights(trainer))


def test_a_loss_that_is_not_finite_stops_before_any_weight_changes(make_trainer):
    trainer = make_trainer(Budget(steps=10))
    for _ in itertools.islice(trainer.run(), 3):
        pass
    with torch.no_grad():
        trainer.model.core.second.node_mlp[-1].bias[:] = torch.inf
    before = weights(trainer)
    with pytest.raises(FloatingPointError, match="The loss is (nan|inf) at step 3; lower the learning rate"):
        next(trainer.run())
    assert_same(weights(trainer), before)
    assert trainer.step == 3


SETTINGS = pytest.mark.skipif(onednn_precision() is None, reason="this torch has no precision of products on a CPU")


@SETTINGS
def test_fast_products_last_as_long_as_their_block():
    cpu, cuda = torch.backends.mkldnn.matmul, torch.backends.cuda.matmul
    before = cpu.fp32_precision, cuda.fp32_precision
    with pytest.raises(RuntimeError), fast_matmul(rounding=True):
        assert (cpu.fp32_precision, cuda.fp32_precision) == ("bf16", "tf32")
        raise RuntimeError
    assert (cpu.fp32_precision, cuda.fp32_precision) == before


def test_fast_products_keep_their_digits_unless_rounding_is_asked_for():
    factor, cuda = torch.randn(300, 300), torch.backends.cuda.matmul.allow_tf32
    exact = factor.double() @ factor.double()
    with fast_matmul():
        product = factor @ factor
        assert torch.backends.cuda.matmul.allow_tf32 == cuda
    assert (product - exact).norm() < 1e-6 * exact.norm()


@SETTINGS
def test_callers_see_their_own_precision_between_steps(make_trainer):
    before = torch.backends.mkldnn.matmul.fp32_precision
    for _ in make_trainer(Budget(steps=2)).run():
        assert torch.backends.mkldnn.matmul.fp32_precision == before


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
def test_cpp_has_all_threads_of_a_step_and_torch_one(make_trainer):
    threads, seen, trained = torch.get_num_threads(), [], []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            trainer = make_trainer(Budget(steps=4))

            def look(*_):
                seen.append((torch.get_num_threads(), native_threads()))

            trainer.loss.register_forward_pre_hook(look)
            for _ in trainer.run():
                assert torch.get_num_threads() == count
            trained.append(weights(trainer))
    finally:
        torch.set_num_threads(threads)
    assert seen == [(1, 1)] * 4 + [(1, 2)] * 4
    torch.testing.assert_close(*trained, rtol=1e-4, atol=1e-5)


def test_workers_that_go_on_draw_noise_of_their_own(make_trainer):
    first = make_trainer(Budget(steps=4))
    list(first.run())
    state = first.state_dict()
    noises = []
    for rank in (0, 1, 2):
        worker = make_trainer(Budget(steps=8), workers=Workers(rank, 3))
        worker.load_state_dict(state)
        noises.append(worker.loss.generator.get_state())
    assert torch.equal(noises[0], first.loss.generator.get_state())
    assert not any(torch.equal(noises[one], noises[other]) for one, other in ((0, 1), (0, 2), (1, 2)))
