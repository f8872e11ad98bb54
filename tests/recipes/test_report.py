"""The report's pages are those of their data, and runs can be added to these."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from _common.report_data import add_run, read_run
from _common.report_pages import make_pages

from .conftest import ROOT

REPORT = ROOT / "docs" / "results"
CLAIM = {
    "title": "Errors",
    "of": "ours",
    "short": "errors are low",
    "claim": "Errors are low.",
    "verdict": "holds",
    "headline": "{best} of 1",
    "values": {"best": {"metric": "error", "of": "errors.first.metrics.json", "format": ".1e"}},
    "tables": [
        {
            "title": "Errors and milliseconds.",
            "columns": ["model", "errors", "ms", "ratio"],
            "rows": [
                [
                    "GN",
                    [
                        {"metric": "error", "of": "errors.first.metrics.json", "format": ".1e", "bold": True},
                        {"metric": "far", "of": "errors.first.metrics.json", "format": ".1e"},
                    ],
                    {"metric": "seconds", "of": "errors.first.metrics.json", "format": ",.0f", "times": 1000},
                    {"metric": "seconds", "of": "errors.first.metrics.json", "format": ".1f", "over": "error"},
                ]
            ],
        },
        {"title": "Before.", "columns": ["error"], "rows": [["0.2"]], "source": "transcribed", "date": "May 2026"},
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


def test_committed_pages_are_those_of_their_data():
    pages = make_pages(REPORT / "data")
    assert pages == {file.name: file.read_text() for file in REPORT.glob("*.md")}


def test_a_run_is_added_with_its_command_and_versions(report, finished):
    file = add_run(report / "data", finished, "errors", {"seed": 0, "run_dir": None, "checkpoint": None, "length": 100})
    added = read_run(report / "data", file.name)
    assert file.name == "errors.first.metrics.json"
    assert added["metrics"] == {"error": 0.00123, "far": None, "seconds": 1.25}
    assert added["run"]["command"] == "python recipes/evaluate.py seed=3 checkpoint=runs/model 'training=[\"lr=1e-3\"]'"
    assert added["run"]["versions"] == {"torch": "2.13"} and added["run"]["seed"] == 3
    with pytest.raises(ValueError, match="to=none is not a claim"):
        add_run(report / "data", finished, "none", {})
    (finished / "metrics.json").unlink()
    with pytest.raises(ValueError, match=r"has no metrics\.json"):
        add_run(report / "data", finished, "errors", {})


def test_tables_quote_runs(report, finished):
    add_run(report / "data", finished, "errors", {})
    pages = make_pages(report / "data")
    assert "| GN | **1.2e-3** / diverges | 1,250 | 1016.3 |" in pages["errors.md"]
    assert "- The best is 1.2e-3." in pages["errors.md"]
    assert "Source: [first](data/errors.first.metrics.json), transcribed, May 2026." in pages["errors.md"]
    assert "| *errors are low* | holds | 1.2e-3 of 1 | [Errors](errors.md) |" in pages["README.md"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"verdict": "yes"}, "verdict='yes' must be one of"),
        ({"text": ["One."] * 6}, "6 sentences of text; 5 at most"),
        ({"tables": [{"title": "", "columns": ["a"] * 9, "rows": []}]}, "9 columns"),
        ({"tables": [{"title": "", "columns": ["a"], "rows": [["1", "2"]]}]}, "2 cells for 1 columns"),
        ({"tables": [{"title": "", "columns": ["a"], "rows": [["long " * 9]]}]}, "more than 40 characters"),
        ({"text": ["{worst}"]}, "worst"),
        ({"values": {"best": {"metric": "none", "of": "errors.first.metrics.json", "format": ""}}}, "none"),
        ({"values": {"best": {"metric": "error", "of": "errors.second.metrics.json", "format": ""}}}, "There is no"),
    ],
)
def test_bad_data_are_refused(report, finished, change, message):
    add_run(report / "data", finished, "errors", {})
    write(report / "data", "errors", CLAIM | change)
    with pytest.raises(ValueError, match=f"errors.json: .*{message}"):
        make_pages(report / "data")


def test_every_claim_is_in_the_index(report):
    write(report / "data", "other", CLAIM)
    with pytest.raises(ValueError, match="other"):
        make_pages(report / "data")


@pytest.mark.slow
def test_recipe_adds_writes_and_checks(run, report, finished):
    folder = f"folder={report}"
    code, said, _ = run(f"add={finished}", "to=errors", folder, recipe="report")
    assert code == 0 and said.splitlines()[:2] == ["error", "far"]
    code, _, errors = run("check=true", folder, recipe="report")
    assert code == 1 and "README.md" in errors
    assert run(folder, recipe="report")[0] == 0
    assert run("check=true", folder, recipe="report")[0] == 0
