"""The report: one HTML file with tables, charts and the worst frames, that needs nothing beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, select_autoescape

from lanestream_exporter.evaluation.bootstrap import SPAN, STILLS
from lanestream_exporter.evaluation.charts import RULE, charts
from lanestream_exporter.evaluation.gallery import gallery
from lanestream_exporter.evaluation.measuring import Evaluation
from lanestream_exporter.evaluation.outcomes import RULES


def write_report(folder: Path, evaluation: Evaluation, figures: Mapping[str, Any]) -> Path:
    """Writes `report.html` into `folder`, which is made where it is missing; the path of the file."""
    environment = Environment(
        loader=PackageLoader("lanestream_exporter.evaluation", ""),
        autoescape=select_autoescape(["html", "jinja"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["share"] = _share
    environment.filters["interval"] = _interval
    first = evaluation.methods[0]
    page = environment.get_template("report.html.jinja").render(
        figures=figures,
        rule=RULE,
        rules=list(RULES),
        block={"stills": STILLS, "span": SPAN},
        charts=charts(evaluation, figures),
        shown=first.name,
        gallery=gallery(evaluation.evaluation_set, evaluation.images[first.name]),
    )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _interval(value: list[float] | None) -> str:
    return "" if value is None else f"[{value[0]:.3f}, {value[1]:.3f}]"
