"""Write the pages of results, docs/results, and README's table of results from their data, docs/results/data.

    python recipes/report.py
    python recipes/report.py check=true
    python recipes/report.py add=runs/benchmark/<time> to=run-time-against-error [as=jaco]

Every claim has a JSON file with the claim, the verdict, tables, commands, seeds, machine and text. A cell of a table is

- a string,
- a metric of a run, {"metric": "one_step_error", "of": "CLAIM.NAME.metrics.json", "format": ".1e"}, where a list of
  metrics is summed, "times": 1000 multiplies, and "over": "another_metric" divides,
- or a list of cells, shown with slashes between.

Text quotes a number of the claim's "values" as {NAME}. "figure" draws numbers of a table
(recipes/_common/report_figures.py) into docs/images/results. Learning curves come from runs added as=TASK-SEED
(recipes/_common/report_curves.py). README's table has the rows that "headlines" of index.json lists. `check=true`
writes nothing and fails if a page or figure differs from its data.

`add=` copies the metrics of a finished run, with its command, date, processor and versions, to CLAIM.NAME.metrics.json,
where `to` is CLAIM and `as` is NAME (default: the run folder's name), and prints the names of the metrics. No figure of
the paper. Takes seconds. All options: recipes/config/report.yaml.
"""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf

from _common import clean_exit, with_help
from _common.report_data import INDEX, add_run, read, read_run, recipe_of
from _common.report_drawing import draw_figure
from _common.report_figures import read_figures, stale_figures
from _common.report_pages import fill_readme, make_pages
from torchrl_gn.atomic import atomic_path

REPORT = Path(__file__).parents[1] / "docs" / "results"


@with_help
@hydra.main(version_base=None, config_path="config", config_name="report")
@clean_exit
def main(cfg: DictConfig) -> None:
    report = Path(cfg.folder) if cfg.folder else REPORT
    data = report / "data"
    if cfg.add:
        if not cfg.to:
            raise ValueError("Say which claim quotes the run: to=forward-predictions, say.")
        run = Path(cfg.add)
        defaults = OmegaConf.to_container(hydra.compose(recipe_of(run)), resolve=True)
        file = add_run(data, run, cfg.to, defaults, cfg["as"])  # pyright: ignore
        print("\n".join(read_run(data, file.name)["metrics"]))
        print(file)
        return
    figures, images = read_figures(data), report.parent / "images" / "results"
    pages = {report / name: text for name, text in make_pages(data).items()}
    there = {file: file.read_text() for file in report.glob("*.md")}
    readme = report.absolute().parents[1] / "README.md"
    if "headlines" in read(data, INDEX):
        there[readme] = readme.read_text()
        pages[readme] = fill_readme(there[readme], data)
    changed = sorted(file for file in pages.keys() | there.keys() if pages.get(file) != there.get(file))
    stale = stale_figures(figures, images)
    if cfg.check and changed + stale:
        files = ", ".join(map(str, [*changed, *(images / name for name in stale)]))
        raise ValueError(f"{files} differ from the data; run python recipes/report.py and commit them.")
    for file in changed:
        if file in pages:
            with atomic_path(file) as temporary:
                temporary.write_text(pages[file])
        else:
            file.unlink()
        print(file)
    for name in stale:
        file = images / name
        draw_figure(figures[file.stem], file) if file.stem in figures else file.unlink()
        print(file)


if __name__ == "__main__":
    main()
