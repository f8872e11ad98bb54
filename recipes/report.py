"""Write the pages of results, docs/results, and README's table of results from their data, docs/results/data.

    python recipes/report.py
    python recipes/report.py check=true
    python recipes/report.py add=runs/benchmarks/work_precision/<time> to=run-time-against-error [as=jaco]

Every page has a JSON file: a claim's has the claim, the verdict, tables, commands, seeds, machine, text and, by name,
the "runs" that these quote. A cell of a table is

- a string,
- a metric of a run, {"metric": "one_step_error", "of": "NAME", "format": ".1e"}, where a list of metrics is summed,
  "times": 1000 multiplies, and "over": "another_metric" divides; a run of another page is "PAGE/NAME", and a list of
  runs stands for their mean,
- or a list of cells, shown with slashes between.

Text quotes a number of the page's "values" as {NAME}. "figure" draws numbers of a table
(recipes/_report/figures.py) into docs/images/results. Learning curves come from runs added as=TASK-SEED
(recipes/_report/curves.py). README's table has the rows that "headlines" of index.json lists. The data files get
one layout, too. `check=true` writes nothing and fails if a page, figure or layout differs from the data's.

`add=` copies the metrics of a finished run, with its command, date, processor and versions, to the runs of the claim
`to`, as `as` (default: the run folder's name), and prints the names of the metrics. No figure of the paper. Takes
seconds. All options: recipes/config/report.yaml.
"""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from _common import clean_exit, with_help
from _report.curves import curves_of
from _report.data import INDEX, layout, read_page, read_pages, recipe_of, with_run
from _report.drawing import draw_figure
from _report.figures import read_figures, stale_figures
from _report.pages import fill_readme, make_pages
from torchrl_gn.atomic import atomic_path

RECIPES = Path(__file__).absolute().parent
REPORT = RECIPES.parent / "docs" / "results"


@with_help
@hydra.main(version_base=None, config_path="config", config_name="report")
@clean_exit
def main(cfg: DictConfig) -> None:
    report = Path(cfg.folder) if cfg.folder else REPORT
    if cfg.add:
        add(cfg, report / "data")
        return
    data = read_pages(report / "data")
    figures, images = read_figures(data), report.parent / "images" / "results"
    pages = {report / name: text for name, text in make_pages(data).items()}
    pages |= {report / "data" / f"{name}.json": layout(page) for name, page in data.items()}
    there = {file: file.read_text() for file in [*report.glob("*.md"), *report.glob("data/[!.]*.json")]}
    readme = report.absolute().parents[1] / "README.md"
    if "headlines" in data[INDEX]:
        there[readme] = readme.read_text()
        pages[readme] = fill_readme(there[readme], data)
    changed = sorted(file for file in pages.keys() | there.keys() if pages.get(file) != there.get(file))
    stale = stale_figures(figures, images)
    if cfg.check and changed + stale:
        files = ", ".join(map(str, [*changed, *(images / name for name in stale)]))
        raise ValueError(f"{files} differ from the data; run python recipes/report.py and commit them.")
    for file in changed:
        if file in pages:
            write(file, pages[file])
        else:
            file.unlink()
        print(file)
    for name in stale:
        file = images / name
        draw_figure(figures[file.stem], file) if file.stem in figures else file.unlink()
        print(file)


def add(cfg: DictConfig, data: Path) -> None:
    """Add the run ``cfg.add`` to the claim ``cfg.to``, and print its metrics and the claim's file.

    Raises:
        ValueError: if there is no such claim, the run is none that it can quote, or a file is damaged.
    """
    claims = read_page(data / f"{INDEX}.json")["order"]
    if cfg.to not in claims:
        raise ValueError(f"to={cfg.to} is not a claim; use one of {sorted(claims)}.")
    run, file = Path(cfg.add), data / f"{cfg.to}.json"
    recipe = RECIPES / recipe_of(run)
    GlobalHydra.instance().clear()  # of this recipe's options: a benchmark's are in another folder
    with hydra.initialize_config_dir(str(recipe.parent / "config"), version_base=None):
        defaults = OmegaConf.to_container(hydra.compose(recipe.name), resolve=True)
    name = run.resolve().name if cfg["as"] is None else str(cfg["as"])
    page = with_run(read_page(file), run, defaults, name)  # pyright: ignore
    if "peers" in page:
        curves_of(page)
    write(file, layout(page))
    print("\n".join(page["runs"][name]["metrics"]))
    print(file)


def write(file: Path, text: str) -> None:
    """Write a file atomically."""
    with atomic_path(file) as temporary:
        temporary.write_text(text)


if __name__ == "__main__":
    main()
