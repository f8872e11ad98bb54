"""Learning curves of the report: ours by task and seed, beside peers'."""

from __future__ import annotations

import pytest

from _report.curves import (
    Curve,
    ahead,
    curve_of,
    curve_panel,
    curve_table,
    curves_of,
    interquartile_interval,
    interquartile_mean,
    mean_at,
    mean_return,
)
from _report.data import read_pages
from _report.drawing import draw_figure
from _report.figures import read_figures, stale_figures
from _report.pages import make_pages

from .conftest import ROOT

PEERS = {
    "sources": {
        "A": {"paper": "A et al.", "seeds": 10, "repository": "a/a", "path": "a.csv", "commit": "1234567890"},
        "B": {"paper": "B et al.", "seeds": 3, "repository": "b/b", "path": "b", "commit": "abcdefghij"},
    },
    "returns": {
        "cheetah-run": {"A": [[0, 1.0], [30, 60.0]], "B": [[0, 2.0], [30, 50.5], [60, 900.0]]},
        "finger-turn_easy": {"A": [[30, 600.0]]},
    },
}
CLAIM = {
    "title": "The suite",
    "of": "ours",
    "short": "more return",
    "claim": "More return.",
    "verdict": "in part",
    "headline": "{ahead} tasks",
    "values": {"ahead": {"ahead": 30, "of": "suite"}},
    "figure": {"kind": "curves", "frames": 40, "axis": "return", "along": "frames, thousands", "alt": "Curves"},
    "tables": [{"title": "Returns.", "curves": [10, 30]}, {"title": "Peers.", "peers": True, "source": "published"}],
    "text": ["Ahead on {ahead}."],
}


def run_of(frames, returns) -> dict:
    """A run of rounds whose minutes are a tenth of their frames."""
    metrics = {"frames": frames[-1], "median_return_of_last_five": returns[-1]}
    for index, (at, value) in enumerate(zip(frames, returns, strict=True)):
        metrics |= {f"round {index}/frames": at, f"round {index}/median_return_of_last_five": value}
        metrics |= {f"round {index}/minutes": at / 10, f"round {index}/return": -1}
    return {"metrics": metrics}


@pytest.fixture
def runs() -> dict:
    """Runs of two tasks, one of which ends early."""
    return {
        "cheetah-run-1": run_of([10, 20, 30], [50, 80, 100]),
        "cheetah-run-0": run_of([10, 20, 30], [40, 50, 60]),
        "finger-turn_easy-10": run_of([8, 16], [100, 200]),
    }


@pytest.fixture
def data(runs) -> dict:
    """Data of a report whose only claim is of these runs."""
    index = {"title": "All", "intro": [], "machine": "A.", "versions": "B.", "notes": [], "order": ["suite"]}
    dropped = {"title": "Dropped", "intro": "None.", "tables": []}
    return {"suite": CLAIM | {"peers": PEERS, "runs": runs}, "index": index, "tried-and-dropped": dropped}


def test_a_curve_goes_on_until_its_next_round_would_end():
    curve = Curve([10, 20, 30], [1, 2, 3], [0, 0, 0])
    assert [curve.round_at(at) for at in (9, 10, 19, 20, 30, 39, 40)] == [None, 0, 0, 1, 2, 2, None]
    single = Curve([10], [1], [0])
    assert [single.round_at(at) for at in (9, 10, 11)] == [None, 0, None]


def test_curves_are_medians_of_rounds():
    assert curve_of(run_of([10, 20], [4, 6])["metrics"]) == Curve([10, 20], [4, 6], [1, 2])


def test_means_are_of_seeds_that_all_run():
    curves = [Curve([10, 20, 30], [1, 2, 3], [1, 2, 3]), Curve([10, 20], [3, 6], [3, 6])]
    assert [mean_at(curves, at) for at in (9, 10, 20, 29, 30)] == [None, 2, 4, 4, None]
    assert mean_at(curves, 20, "minutes") == 4


def test_the_best_peer_is_one_with_these_frames(data):
    def best(frames):
        return curve_table(data["suite"], [frames])["rows"][0][3]

    assert best(30) == "A 60" and best(60) == "B 900" and best(31) == "-"


def test_tables_list_tasks_beside_the_best_peer(data):
    table = curve_table(data["suite"], [10, 30])
    assert table["columns"] == ["task", "seeds", "at 10", "at 30", "best peer at 30", "minutes for 30"]
    assert table["rows"] == [
        ["cheetah run", "2", "45", "**80**", "A 60", "3"],
        ["finger turn easy", "1", "100", "-", "A 600", "-"],
        ["mean of 2 tasks", "3", "72", "-", "A 330", "-"],
    ]
    assert ahead(data["suite"], 30) == "1 of 1"


def test_the_higher_one_is_bold(data, runs):
    runs["cheetah-run-1"] = run_of([10, 20, 30], [1, 1, 1])
    assert curve_table(data["suite"], [30])["rows"][0] == ["cheetah run", "2", "30", "**A 60**", "3"]
    assert ahead(data["suite"], 30) == "0 of 1"
    runs["cheetah-run-1"] = run_of([10, 20, 30], [61, 61, 61])  # the mean is 60.5, the figures shown are equal
    assert curve_table(data["suite"], [30])["rows"][0] == ["cheetah run", "2", "**60**", "**A 60**", "3"]
    assert ahead(data["suite"], 30) == "0 of 1"


def test_the_planners_return_has_a_column_where_all_seeds_have_one(data, runs):
    runs["cheetah-run-1"] = run_of([10, 20, 30], [50, 40, 30])
    runs["cheetah-run-1"]["metrics"]["planned/return"] = 90.0
    table = curve_table(data["suite"], [10, 30])
    assert table["columns"][3:5] == ["at 30", "at 30, planned"]
    assert table["rows"][0] == ["cheetah run", "2", "45", "45", "-", "**A 60**", "3"]
    assert ahead(data["suite"], 30) == "0 of 1"
    runs["cheetah-run-0"]["metrics"]["planned/return"] = 70.0
    assert curve_table(data["suite"], [10, 30])["rows"][0] == ["cheetah run", "2", "45", "45", "**80**", "A 60", "3"]
    assert ahead(data["suite"], 30) == "1 of 1"
    runs["cheetah-run-0"]["metrics"]["planned/return"] = 0.0
    assert ahead(data["suite"], 30) == "0 of 1"


def test_means_over_tasks_need_all_tasks(data, runs):
    runs["finger-turn_easy-10"] = run_of([10, 30], [100, 700])
    assert curve_table(data["suite"], [30])["rows"][2] == ["mean of 2 tasks", "3", "**390**", "A 330", "3"]
    assert mean_return(data["suite"], 30, "policy") == "390" and mean_return(data["suite"], 30, "best_peer") == "A 330"
    with pytest.raises(ValueError, match="a task has no return of planned at 30 frames"):
        mean_return(data["suite"], 30, "planned")
    for at, run in enumerate(runs.values()):
        run["metrics"]["planned/return"] = [90.0, 70.0, 600.0][at]
    assert mean_return(data["suite"], 30, "planned") == "340"
    del data["suite"]["peers"]["returns"]["finger-turn_easy"]
    assert curve_table(data["suite"], [30])["rows"][2][-2] == "-"


def test_pages_name_runs_and_sources(data):
    page = make_pages(data)["suite.md"]
    assert "| cheetah run | 2 | 45 | **80** | A 60 | 3 |" in page
    assert "| B | B et al. | 3 | b/b | [b](https://github.com/b/b/blob/abcdefghij/b) | abcdefg |" in page
    assert "Source: [suite.json](data/suite.json), published." in page
    assert "- Ahead on 1 of 1." in page and "| 1 of 1 tasks |" in make_pages(data)["README.md"]


def test_panels_show_single_seeds_or_an_interval():
    two = [Curve([10, 20], [0, 100], [0, 0]), Curve([10, 20, 30], [100, 200, 300], [0, 0, 0])]
    panel = curve_panel(two, {"A": [(0, 1.0)]})
    assert panel["mean"] == [(10, 50), (20, 150)] and panel["band"] == []
    assert panel["seeds"] == [[(10, 0), (20, 100)], [(10, 100), (20, 200), (30, 300)]]
    assert panel["peers"] == {"A": [(0, 1)]}
    three = curve_panel([*two, Curve([10, 20], [50, 150], [0, 0])], {})
    assert three["seeds"] == [] and three["band"] == [(10, 0, 100), (20, 100, 200)]


def test_panels_show_the_planners_mean_once_all_seeds_have_one():
    one, other = Curve([10, 20], [0, 100], [0, 0], planned=200.0), Curve([10, 20], [0, 100], [0, 0])
    assert curve_panel([one], {})["planned"] == [(20, 200)]
    assert curve_panel([one, other], {})["planned"] == []


def test_curves_are_in_the_order_of_tasks_and_seeds(data, runs):
    runs["cheetah-run-11"] = run_of([5], [7])
    runs["cheetah-run-2"] = run_of([5], [6])
    curves = curves_of(data["suite"])
    assert list(curves) == ["cheetah-run", "finger-turn_easy"]
    assert [curve.returns[0] for curve in curves["cheetah-run"]] == [40, 50, 6, 7]


@pytest.mark.parametrize("name", ["cheetah", "cheetah-run-a"])
def test_runs_are_named_by_task_and_seed(data, runs, name):
    runs[name] = run_of([1], [1])
    with pytest.raises(ValueError, match="must name a task and a seed; add it as=cheetah-run-0"):
        curves_of(data["suite"])


def test_runs_need_rounds(data, runs):
    runs["cheetah-run-2"] = {"metrics": {"error": 0.1}}
    with pytest.raises(ValueError, match="the run cheetah-run-2 has no rounds"):
        curves_of(data["suite"])


def test_a_claim_needs_runs(data, runs):
    runs.clear()
    with pytest.raises(ValueError, match="suite.json: there is no run; add one"):
        make_pages(data)


@pytest.mark.parametrize("panels", [1, 2, 4, 5, 9])
def test_figures_are_drawn_and_become_stale(data, runs, tmp_path, panels):
    for task in range(panels - 2):
        for seed in range(3):
            runs[f"task-{task}-{seed}"] = run_of([9, 18], [seed, 300])
    if panels == 1:
        del runs["finger-turn_easy-10"]
    figures = read_figures(data)
    assert len(figures["suite"].panels) == panels and stale_figures(figures, tmp_path) == ["suite.png"]
    draw_figure(figures["suite"], tmp_path / "suite.png")
    assert stale_figures(figures, tmp_path) == []
    runs["cheetah-run-1"] = run_of([10, 20, 30], [50, 80, 101])
    assert stale_figures(read_figures(data), tmp_path) == ["suite.png"]


def test_figures_of_curves_take_no_options_of_tables(data):
    data["suite"]["figure"] = CLAIM["figure"] | {"y": ["return"]}
    with pytest.raises(ValueError, match=r"suite.json, figure: unknown options \['y'\]"):
        read_figures(data)


def test_committed_peers_name_their_sources():
    pages = read_pages(ROOT / "docs" / "results" / "data").values()
    committed = [page["peers"] for page in pages if "peers" in page]
    assert committed
    for peers in committed:
        for source in peers["sources"].values():
            assert source["seeds"] and source["paper"] and source["repository"] and len(source["commit"]) == 40
        for lines in peers["returns"].values():
            assert lines.keys() <= peers["sources"].keys()
            assert all(line == sorted(line) and len(line) <= 15 for line in lines.values())


@pytest.mark.parametrize(
    ("level", "expected"),
    [(0.95, (0, 1)), (0.6, (0, 1)), (0.4, (0.5, 0.5))],
)
def test_interval_of_two_runs(level, expected):
    """The samples of two runs have the mean 0 (a quarter), 0.5 (half) and 1 (a quarter)."""
    assert interquartile_interval([0, 1], level=level) == expected


def test_interval_of_three_runs():
    """One of 27 samples holds only the least score, 1 / 27 > 0.025; the three of mean 1 end at 4 / 27."""
    runs = [0, 3, 6]
    assert interquartile_interval(runs) == (0, 6)
    assert interquartile_interval(runs, level=0.8, samples=20_000) == (1, 5)


def test_the_interval_leaves_out_the_extremes_of_samples():
    """The middle two of four scores count; 74 % of the samples have at most one outlier."""
    assert interquartile_interval([0, 0, 0, 1000], level=0.4) == (0, 0)
    assert interquartile_interval([0, 0, 0, -1000], level=0.4) == (0, 0)


def test_intervals_share_their_draws():
    assert interquartile_interval([1, 2, 4], seed=3) == interquartile_interval([1, 2, 4], seed=3)
    low, high = interquartile_interval([1, 2, 4])
    assert interquartile_interval([11, 12, 14]) == pytest.approx((low + 10, high + 10))


def test_samples_draw_the_seeds_of_each_task():
    """One seed of each task: nothing to draw; of two tasks with two seeds, each sample has two scores of both."""
    assert interquartile_interval([0], [1], [8]) == (3, 3) and interquartile_mean([0], [1], [8]) == 3
    assert interquartile_mean([0, 2], [4, 100]) == 3
    assert interquartile_interval([0, 0], [1, 1]) == (0.5, 0.5)
    assert interquartile_interval([0, 0, 1, 1]) != (0.5, 0.5)
