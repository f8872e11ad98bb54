"""The report's pages match their data, and runs can be added to the data."""

from __future__ import annotations

import difflib
import json
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from _report.data import DROPPED, INDEX, layout, read_page, read_pages, with_run
from _report.drawing import _name_places, draw_figure
from _report.figures import numbers, read_figures, stale_figures
from _report.pages import fill_readme, make_pages, shown
from torchrl_gn.drawing.canvas import new_figure

from .conftest import ROOT

REPORT = ROOT / "docs" / "results"
LARGER = {"control-suite.png": 100_000}  # of up to twenty panels
CLAIM = {
    "title": "Errors",
    "of": "ours",
    "short": "errors are low",
    "claim": "Errors are low.",
    "verdict": "holds",
    "headline": "{best} of 1",
    "values": {"best": {"metric": "error", "of": "first", "format": ".1e"}},
    "figure": {"kind": "dots", "row": "{model}", "y": ["ms"], "axis": "ms", "alt": "The best of {best}"},
    "tables": [
        {
            "title": "Errors and milliseconds.",
            "columns": ["model", "errors", "ms", "ratio"],
            "rows": [
                [
                    "GN",
                    [
                        {"metric": "error", "of": "first", "format": ".1e", "bold": True},
                        {"metric": "far", "of": "first", "format": ".1e"},
                    ],
                    {"metric": "seconds", "of": "first", "format": ",.0f", "times": 1000},
                    {"metric": "seconds", "of": "first", "format": ".1f", "over": "error"},
                ]
            ],
        },
        {"title": "Before.", "columns": ["error"], "rows": [["0.2"]], "source": "published"},
    ],
    "command": ["python recipes/evaluate.py checkpoint=swimmer6"],
    "seeds": "0",
    "text": ["The best is {best}."],
}
METRICS = {"error": 0.00123, "far": None, "seconds": 1.25, "seed": 3, "processor": "some", "version/torch": "2.13"}


@pytest.fixture
def report(tmp_path) -> Path:
    """A report of one claim, whose table quotes a run."""
    data = tmp_path / "report" / "data"
    data.mkdir(parents=True)
    write(
        data,
        "index",
        {"title": "All", "intro": ["One."], "machine": "A.", "versions": "B.", "notes": [], "order": ["errors"]},
    )
    write(data, "tried-and-dropped", {"title": "Dropped", "intro": "None.", "tables": []})
    write(data, "errors", CLAIM)
    return data.parent


@pytest.fixture
def finished(tmp_path) -> Path:
    run = tmp_path / "first"
    run.mkdir()
    (run / "config.yaml").write_text(
        "# A run of evaluate\nseed: 3\nrun_dir: /some/first\ncheckpoint: /some/model\nlength: 100\n"
        "training: [lr=1e-3]\n"
    )
    (run / "metrics.json").write_text(json.dumps(METRICS))
    return run


def write(data: Path, name: str, values) -> None:
    (data / f"{name}.json").write_text(json.dumps(values))


def pages_of(report: Path) -> dict:
    return read_pages(report / "data")


def add(report: Path, run: Path, name: str = "first", claim: str = "errors", metrics: dict | None = None) -> dict:
    """Add a run with METRICS, some replaced by ``metrics``, to a claim, and return what the claim has of it."""
    (run / "metrics.json").write_text(json.dumps(METRICS | (metrics or {})))
    defaults = {"seed": 0, "run_dir": None, "checkpoint": None, "length": 100}
    file = report / "data" / f"{claim}.json"
    file.write_text(layout(with_run(read_page(file), run, defaults, name)))
    return read_page(file)["runs"][name]


def test_a_cell_may_compare_two_runs(report, finished):
    add(report, finished)
    add(report, finished, "second", metrics={"seconds": 5.0})
    over = {"metric": "seconds", "of": "second"}
    cell = {"metric": "seconds", "of": "first", "format": ".2f", "over": over}
    assert shown(cell, "errors", pages_of(report)) == "0.25"
    assert shown(cell | {"times": 4}, "errors", pages_of(report)) == "1.00"


def test_a_cell_may_be_the_mean_over_seeds(report, finished):
    for name, metrics in {"first": {"seconds": 1.0}, "second": {"seconds": 4.0}, "third": {"seconds": None}}.items():
        add(report, finished, name, metrics=metrics)
    cell = {"metric": "seconds", "of": ["first", "errors/second"], "format": ".1f", "times": 2}
    assert shown(cell, "errors", pages_of(report)) == "5.0"
    assert shown(cell | {"of": ["first", "third"]}, "errors", pages_of(report)) == "diverges"


def test_a_claim_may_quote_another_claims_run(report, finished):
    write(report / "data", "index", read_page(report / "data" / "index.json") | {"order": ["errors", "other"]})
    cell = {"metric": "seconds", "of": "errors/first", "format": ".2f"}
    table = {"title": "", "columns": ["seconds"], "rows": [[cell]]}
    write(report / "data", "other", CLAIM | {"values": {"best": cell}, "tables": [table]})
    with pytest.raises(ValueError, match=r"There is no run first in errors\.json; add it: .* to=errors as=first"):
        make_pages(pages_of(report))
    add(report, finished)
    page = make_pages(pages_of(report))["other.md"]
    assert "| 1.25 |" in page and "- The best is 1.25." in page
    assert "Source: [errors.json](data/errors.json)." in page
    add(report, finished, claim="other", metrics={"seconds": 9.0})  # of the same name: not the one that is quoted
    page = make_pages(pages_of(report))["other.md"]
    assert "| 1.25 |" in page and "Source: [other.json](data/other.json), [errors.json](data/errors.json)." in page


def test_errors_have_units(report, finished):
    add(report, finished, metrics={"rollout_error_100/position": 0.04, "rollout_error_100/baseline/position": 0.25})
    cell, pages = (
        {"metric": "rollout_error_100/position", "of": "first", "format": ".2f", "rms": True},
        pages_of(report),
    )
    assert shown(cell, "errors", pages) == "0.10" and shown(cell | {"times": 1000}, "errors", pages) == "100.00"
    assert shown(cell | {"metric": "rollout_error_100/baseline/position"}, "errors", pages) == "0.50"


NAMES = st.sampled_from(["round 0/frames", "round 0/return", "round 1/frames", "long " * 30, "'\"/±\n"])
VALUES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | NAMES
ENTRIES = st.recursive(VALUES, lambda each: st.lists(each) | st.dictionaries(NAMES, each), max_leaves=12)


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(page=st.dictionaries(NAMES, ENTRIES))
def test_a_layout_keeps_values_and_their_order(page):
    assert json.dumps(json.loads(layout(page))) == json.dumps(page)


def test_layout_is_made_to_be_read():
    numbers = {"seconds": 0.5, "frames": 30, "round 0/frames": 10, "round 0/return": -1.5, "round 1/frames": None}
    page = {
        "title": "A",
        "row": ["a" * 80, {"b": "b" * 80}],
        "lines": [[1, 2.5]] * 30,
        "metrics": numbers | {"c": "c" * 80},
    }
    assert layout(page).splitlines() == [
        "{",
        '  "title": "A",',
        '  "row": [',
        f'    "{"a" * 80}",',
        f'    {{"b": "{"b" * 80}"}}',
        "  ],",
        f'  "lines": [{", ".join(["[1, 2.5]"] * 30)}],',
        '  "metrics": {',
        '    "seconds": 0.5, "frames": 30,',
        '    "round 0/frames": 10, "round 0/return": -1.5,',
        '    "round 1/frames": null,',
        f'    "c": "{"c" * 80}"',
        "  }",
        "}",
    ]


def test_an_added_run_is_one_block(report, finished):
    add(report, finished, "c")
    add(report, finished, "a")
    file = report / "data" / "errors.json"
    before = file.read_text().splitlines()
    add(report, finished, "b")
    changes = difflib.SequenceMatcher(None, before, file.read_text().splitlines(), autojunk=False).get_opcodes()
    assert [change[0] for change in changes] == ["equal", "insert", "equal"]
    assert list(read_page(file)["runs"]) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"title": "Err', "Unterminated string"),
        ('{"title": "", "runs": {"a": {}, "b": {}, "a": {}}}', "a is there twice"),
        ('{"runs": {"a": {"metrics": {"error": NaN}}}}', "Out of range float values"),
        ("[]", "it holds no names"),
    ],
)
def test_damaged_files_are_refused(report, finished, text, message):
    file = report / "data" / "errors.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"errors\.json is damaged \(.*{message}.*\); correct it"):
        read_pages(report / "data")
    with pytest.raises(ValueError, match=r"errors\.json is damaged"):
        add(report, finished)
    assert file.read_text() == text


@pytest.mark.slow
def test_committed_pages_are_those_of_their_data():
    data = read_pages(REPORT / "data")
    assert make_pages(data) == {file.name: file.read_text() for file in REPORT.glob("*.md")}
    readme = (ROOT / "README.md").read_text()
    assert fill_readme(readme, data) == readme
    assert [name for name, page in data.items() if layout(page) != (REPORT / "data" / f"{name}.json").read_text()] == []


def test_readmes_table_quotes_runs(report, finished):
    add(report, finished)
    headlines = {"columns": ["what", "ours"], "rows": [["error", "**{best}**"]]}
    values = {"best": CLAIM["values"]["best"] | {"of": "errors/first"}}
    index = read_page(report / "data" / "index.json")
    write(report / "data", "index", index | {"headlines": headlines, "values": values})
    data = pages_of(report)
    before = "# Some\n\n## Results\n\n| old |\n| --- |\n| 1 |\n\nAfter.\n"
    after = "# Some\n\n## Results\n\n| what | ours |\n| --- | --- |\n| error | **1.2e-3** |\n\nAfter.\n"
    assert fill_readme(before, data) == fill_readme(after, data) == after
    with pytest.raises(ValueError, match="README.md has no table"):
        fill_readme("# Some\n\n## Results\n\nNone.\n", data)


@pytest.mark.slow
def test_committed_figures_are_those_of_their_data():
    assert stale_figures(read_figures(read_pages(REPORT / "data")), REPORT.parent / "images" / "results") == []


def test_every_claim_has_a_picture():
    pages = {file.stem: file.read_text() for file in REPORT.glob("*.md")}
    without = {name for name, text in pages.items() if "](../images/" not in text}
    assert without == {"README", "tried-and-dropped"}
    pictures = list((REPORT.parent / "images" / "results").iterdir())
    assert [file.name for file in pictures if file.stat().st_size > LARGER.get(file.name, 40_000)] == []


def test_every_row_of_a_table_quotes_a_run():
    """Unless its table says where else its numbers are from."""
    for file in sorted((REPORT / "data").glob("*.json")):
        if file.stem in (INDEX, DROPPED):
            continue
        for table in json.loads(file.read_text())["tables"]:
            if "curves" in table or "peers" in table:  # made of runs, and of files of sources
                continue
            typed = [row for row in table["rows"] if '"metric"' not in json.dumps(row)]
            assert not typed or table.get("source") in ("published", "the other tables"), (file.name, typed)


def test_a_run_is_added_with_its_command_and_versions(report, finished):
    added = add(report, finished)
    assert added["metrics"] == {"error": 0.00123, "far": None, "seconds": 1.25}
    assert added["command"] == "python recipes/evaluate.py seed=3 checkpoint=runs/model 'training=[\"lr=1e-3\"]'"
    assert added["versions"] == {"torch": "2.13"} and added["seed"] == 3
    assert add(report, finished, metrics={"seconds": 2.5})["metrics"]["seconds"] == 2.5  # in place of the one before
    assert {name: value for name, value in pages_of(report)["errors"].items() if name != "runs"} == CLAIM


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("metrics.json", None, r"has no metrics\.json; name the folder of a finished run"),
        ("metrics.json", '{"error": 0.', r"metrics\.json is damaged"),
        ("metrics.json", '{"error": 0.1, "sha256": "0"}', r"metrics\.json is damaged \(checksum differs\)"),
        ("metrics.json", "[]", r"metrics\.json has no metrics"),
        ("config.yaml", "# A run of evaluate\nseed: [3", r"config\.yaml is damaged"),
        ("config.yaml", "seed: 3\n", r"config\.yaml begins with 'seed: 3', not with '# A run of'"),
        ("config.yaml", "# A run of something\nseed: 3\n", r"begins with '# A run of something', not with"),
    ],
)
def test_other_folders_than_finished_runs_are_refused(finished, file, text, message):
    (finished / file).unlink()
    if text is not None:
        (finished / file).write_text(text)
    with pytest.raises(ValueError, match=message):
        with_run(CLAIM, finished, {}, "first")


def test_names_that_look_like_another_claims_are_refused(finished):
    with pytest.raises(ValueError, match="as=errors/first has a slash"):
        with_run(CLAIM, finished, {}, "errors/first")


def test_tables_quote_runs(report, finished):
    add(report, finished)
    pages = make_pages(pages_of(report))
    assert "| GN | **1.2e-3** / diverges | 1,250 | 1016.3 |" in pages["errors.md"]
    assert "![The best of 1.2e-3](../images/results/errors.png)" in pages["errors.md"]
    assert "- The best is 1.2e-3." in pages["errors.md"]
    assert "Source: [errors.json](data/errors.json), published." in pages["errors.md"]
    assert "| *errors are low* | holds | 1.2e-3 of 1 | [Errors](errors.md) |" in pages["README.md"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"verdict": "yes"}, "verdict='yes' must be one of"),
        ({"text": ["One."] * 6}, "6 sentences of text; 5 at most"),
        ({"tables": [{"title": "", "columns": ["a"] * 9, "rows": []}]}, "9 columns"),
        ({"tables": [{"title": "", "columns": ["a"], "rows": [["1", "2"]]}]}, "2 cells for 1 columns"),
        ({"tables": [{"title": "", "columns": ["a"], "rows": [["long " * 15]]}]}, "more than 72 characters"),
        ({"text": ["{worst}"]}, "worst"),
        ({"values": {"best": {"metric": "none", "of": "first", "format": ""}}}, "none"),
        ({"values": {"best": {"metric": "error", "of": "second", "format": ""}}}, "There is no"),
    ],
)
def test_bad_data_are_refused(report, finished, change, message):
    run = add(report, finished)
    write(report / "data", "errors", CLAIM | change | {"runs": {"first": run}})
    with pytest.raises(ValueError, match=f"errors.json: .*{message}"):
        make_pages(pages_of(report))


def test_every_claim_is_in_the_index(report):
    write(report / "data", ".errors.0a1b2c3d", CLAIM)  # a killed process left it
    assert list(pages_of(report)) == ["errors", "index", "tried-and-dropped"]
    write(report / "data", "errors.first.metrics", {})
    with pytest.raises(ValueError, match=r"differ: \['errors\.first\.metrics'\]"):
        pages_of(report)


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("**3.02**", [3.02]),
        ("1.4e-3 / 11 / 8.6", [1.4e-3, 11, 8.6]),
        ("42.8 (40.0 to 44.2)", [42.8, 40, 44.2]),
        ("5.7e-3 ± 4e-4", [5.7e-3, 4e-4]),
        ("46,879", [46879]),
        ("9.2e-3, 7.6e-3,1,200", [9.2e-3, 7.6e-3, 1200]),
        ("0.117-0.121", [0.117, 0.121]),
        ("-1.39, -0.0016 (0.0010)", [-1.39, -0.0016, 0.001]),
        ("**1e-06** `17 %`", [1e-6, 17]),
        ("step, batch 2,000 of H2O in m²", [2000]),
        ("3e-4 / diverges", [3e-4, float("inf")]),
        ("not run", []),
        ("", []),
    ],
)
def test_numbers_of_a_cell(cell, expected):
    assert numbers(cell) == expected


TABLE = {
    "title": "",
    "columns": ["model, seed", "steps", "reward", "best"],
    "rows": [
        ["`GN`, 0", "1", "**2** (0.5)", "4"],
        ["`GN`, 1", "1", "3 (0.25)", "4"],
        ["MLP, 0", "10", "1 (1)", "2"],
        ["MLP, 1", "", "", "2"],
    ],
}
FIGURE = {"kind": "dots", "row": "{model, seed}", "y": ["reward"], "axis": "reward", "alt": "Rewards"}


def panels_of(report, **options):
    write(report / "data", "errors", CLAIM | {"tables": [TABLE], "values": {}, "headline": "", "figure": options})
    return read_figures(pages_of(report))["errors"].panels


def test_figures_take_the_numbers_that_they_name(report):
    spread = {"column": "reward", "spread": 1, "name": "m/s"}
    points = panels_of(report, **FIGURE | {"y": [spread], "until": ","})
    assert points == {"": {"GN": {"m/s": [(2, 0.5), (3, 0.25)]}, "MLP": {"m/s": [(1, 1)]}}}
    everything = {"column": 2, "take": "all"}
    points = panels_of(report, **FIGURE | {"y": [everything], "rows": [0], "transpose": True})
    assert points == {"": {"reward": {"GN, 0": [(2, 0), (0.5, 0)]}}}
    points = panels_of(report, **FIGURE | {"between": ["steps", "best"], "rows": [1], "panel": "{best}"})
    assert points == {"4": {"GN, 1": {"reward": [(66.666667, 0)]}}}
    points = panels_of(report, **FIGURE | {"y": [{"column": "reward", "spread": "best"}], "rows": [2]})
    assert points == {"": {"MLP, 0": {"reward": [(1, 2)]}}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "pie"}, "kind='pie' must be one of"),
        ({"colour": "red"}, r"unknown options \['colour'\]"),
        ({"alt": ""}, "must describe the figure"),
        ({"y": ["speed"]}, "speed"),
        ({"y": ["model, seed"], "rows": [2], "row": "{best}", "labels": ["a", "b"]}, "zip"),
        ({"y": [{"column": "best", "take": 1}]}, "index out of range"),
    ],
)
def test_bad_figures_are_refused(report, change, message):
    with pytest.raises(ValueError, match=f"errors.json, figure: .*{message}"):
        panels_of(report, **FIGURE | change)


def test_what_diverged_is_not_drawn(report):
    table = TABLE | {"rows": [["GN", "1", "diverges", "2"]]}
    write(report / "data", "errors", CLAIM | {"tables": [table], "figure": FIGURE})
    with pytest.raises(ValueError, match="'diverges' has no number to draw; leave its row out"):
        read_figures(pages_of(report))


LINES = {"kind": "lines", "row": "{steps}", "rows": [0, 1, 2], "y": ["reward", "best"], "along": "steps", "log": True}


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "bars", "until": ",", "ours": ["GN"], "at": 2.5},
        {"y": ["reward", "best"], "log": True},
        {"panel": "{best}", "transpose": True, "from": 0},
        LINES,
    ],
    ids=["bars", "dots", "panels", "lines"],
)
def test_figures_are_stale_without_being_drawn_again(report, monkeypatch, options):
    panels_of(report, **FIGURE | options)
    images, figures = report / "images", read_figures(pages_of(report))
    assert stale_figures(figures, images) == ["errors.png"]
    draw_figure(figures["errors"], images / "errors.png")
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # as if it were not installed
    assert stale_figures(figures, images) == []
    (images / "old.png").write_bytes((images / "errors.png").read_bytes())
    assert stale_figures(figures, images) == ["old.png"]
    (images / "old.png").unlink()
    whole = (images / "errors.png").read_bytes()
    (images / "errors.png").write_bytes(whole[:10])
    assert stale_figures(figures, images) == ["errors.png"]
    (images / "errors.png").write_bytes(whole)
    panels_of(report, **FIGURE | options | {"axis": "return"})
    assert stale_figures(read_figures(pages_of(report)), images) == ["errors.png"]


@pytest.mark.slow
@pytest.mark.parametrize("columns", [1, 3])
def test_names_of_places_do_not_overlap(columns):
    """Seven rounds of a run, a few per cent of the panel apart, in panels beside each other."""
    canvas = new_figure((7, 2.8))
    axes = canvas.subplots(1, columns, squeeze=False)[0, -1]
    places = [42_400, 49_600, 59_200, 68_800, 78_400, 88_000, 100_000]
    axes.plot(places, places)
    _name_places(axes, places)
    canvas.draw_without_rendering()
    boxes = [label.get_window_extent() for label in axes.get_xticklabels() if label.get_text()]
    assert axes.get_xticklabels()[-1].get_text() == "100,000" and len(axes.get_xticks()) == 7 and len(boxes) >= 3
    assert all(before.x1 < after.x0 for before, after in zip(boxes, boxes[1:], strict=False))


def test_numbers_that_change_make_a_figure_stale(report, finished):
    add(report, finished)
    figure = read_figures(pages_of(report))["errors"]
    draw_figure(figure, report / "images" / "errors.png")
    add(report, finished, metrics={"seconds": 2})
    assert stale_figures(read_figures(pages_of(report)), report / "images") == ["errors.png"]


@pytest.mark.slow
def test_recipe_adds_writes_and_checks(run, call, report, finished):
    folder, file = f"folder={report}", report / "data" / "errors.json"
    code, said, _ = run(f"add={finished}", "to=errors", folder, recipe="report")
    assert code == 0 and said.splitlines() == ["error", "far", "seconds", str(file)]
    code, _, errors = call("check=true", folder, recipe="report")
    assert code == 1 and "README.md" in errors and "errors.png" in errors and "index.json" in errors
    assert call(folder, recipe="report")[0] == 0
    assert call("check=true", folder, recipe="report")[0] == 0
    laid_out = file.read_text()
    file.write_text(json.dumps(json.loads(laid_out)))
    assert call("check=true", folder, recipe="report")[0] == 1
    assert call(folder, recipe="report")[0] == 0 and file.read_text() == laid_out
    (report.parent / "images" / "results" / "errors.png").unlink()
    assert call("check=true", folder, recipe="report")[0] == 1
    code, _, errors = call(f"add={finished}", "to=none", folder, recipe="report")
    assert code == 1 and "to=none is not a claim; use one of ['errors']" in errors
    curves = json.loads(laid_out) | {"runs": {}, "peers": {"sources": {}, "returns": {}}}
    write(report / "data", "errors", curves)
    code, _, errors = run(f"add={finished}", "to=errors", "as=cheetah-run-0", folder, recipe="report")
    assert code == 1 and "the run cheetah-run-0 has no rounds" in errors and read_page(file) == curves
