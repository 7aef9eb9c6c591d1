"""A fitted pipeline as one HTML page that needs nothing else, not even a script."""

from __future__ import annotations

import inspect
import io
import platform
import re
import textwrap
from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager
from datetime import date
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from ...data.tables import Table
from ...exceptions import collected
from ...exceptions import version as own_version
from ...inspection.bode import BodeDisplay
from ...inspection.drawing import with_unit
from ...inspection.parameters import ParameterDisplay
from ...inspection.poles import PoleDisplay
from ...inspection.residuals import ResidualDisplay
from ...inspection.simulation import SimulationDisplay
from ...inspection.uncertainty import UncertaintyDisplay
from ...metrics.reports import LABEL, as_shown, fit_report, readable_report
from ...metrics.scorers import InitialState
from ...models.statespace import StateSpace
from ...structures.structure import GrayBoxStructure
from .tables import Summary

_WIDTH = 4.4  # inches of a figure: the width of a telephone
_HEIGHT, _ROW = 2.9, 2.1  # inches of a single panel, of one among several rows

_MOST_FIGURES = 24  # of one kind; more would be looked at by nobody

_PACKAGES = ("numpy", "scipy", "scikit-learn", "pandas", "matplotlib")

_NAME = 40  # characters of a figure's file

# Options that change where and how fast a model is found, not which.
_IMMATERIAL = ("memory", "n_jobs", "verbose")

_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 1rem; max-width: 76rem; color: #1a1a1a;
  background: #fff; font: 1rem/1.5 system-ui, "DejaVu Sans", Arial, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; padding-top: .6rem;
  border-top: 1px solid #ccc; }
nav a { display: inline-block; margin: 0 1rem .3rem 0; }
a { color: #005a8f; }
pre { font: .875rem/1.45 ui-monospace, "DejaVu Sans Mono", monospace; padding: .8rem;
  background: #f4f4f2; border-radius: .3rem; }
pre.text { white-space: pre-wrap; overflow-wrap: anywhere; }
.scroll, pre.code { overflow-x: auto; }
.figures + .scroll { margin-top: 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; text-align: right; white-space: nowrap; }
th { font-weight: 600; border-bottom: 2px solid #888; }
thead th { white-space: normal; vertical-align: bottom; }
tbody th { text-align: left; border-bottom: 0; }
tbody tr:nth-child(odd) { background: #f4f4f2; }
.figures { display: grid; gap: 1.2rem; margin-top: 1.2rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr)); }
figure { margin: 0; min-width: 0; }
figure.wide { grid-column: 1 / -1; }
figure.wide svg { min-width: 44rem; }
figcaption { font-size: .9rem; color: #444; }
svg { display: block; width: 100%; height: auto; }
.warnings li { margin-bottom: .6rem; overflow-wrap: anywhere; }
.note { color: #444; font-size: .9rem; }
@media print { .scroll { overflow: visible; } nav { display: none; } }
"""


def html_report(
    pipeline: Any,
    summary: Summary,
    X: Any,
    y: Any,
    *,
    initial_state: InitialState,
    title: str | None,
    units: Mapping[str, str],
    figures: Path | None,
) -> str:
    """The page; arguments as of `LocalLPVPipeline.to_html_report`."""
    if X is not None and y is None:
        raise ValueError("`y` must come with `X`, the outputs to compare. Got None.")
    page = _Page(units, figures)
    headline, *rest = summary.lines
    with page.section("What was identified"):
        page.preformatted("\n".join(rest).strip("\n"))
    with page.section("Warnings"):
        page.warnings(pipeline.warnings_, "The fit gave no warnings.")
    with page.section("How good it is at each operating point"):
        page.table(summary.points)
        page.note(
            "BFT in percent, 100 is perfect, of a simulation of the estimation data. "
            "Errors are H-infinity norms relative to the model's."
        )
    if summary.parameters is not None:
        with page.section("Parameters"):
            page.table(summary.parameters)
            page.parameters(pipeline)
    if summary.refinement:
        with page.section("Refinement"):
            page.code(summary.refinement)
    with page.section("Poles and responses"):
        page.responses(pipeline)
    if X is not None:
        with page.section("Measured and simulated"):
            page.simulations(pipeline, X, y, initial_state)
        with page.section("Tests of the simulation errors"):
            page.residuals(pipeline, X, y)
    with page.section("The code that makes it"):
        page.code(reproducing_code(pipeline))
    with page.section("Versions"):
        page.table(_versions())
    return page.text(title or headline)


class _Page:
    """Sections of a page, as they are written one after another."""

    def __init__(self, units: Mapping[str, str], figures: Path | None) -> None:
        self._units, self._folder = units, figures
        if figures is not None:
            figures.mkdir(parents=True, exist_ok=True)
        self._parts: list[str] = []
        self._titles: list[str] = []
        self._n_figures = 0

    @contextmanager
    def section(self, title: str) -> Iterator[None]:
        self._titles.append(title)
        self._parts.append(f'<section id="s{len(self._titles)}">\n<h2>{title}</h2>')
        yield
        self._parts.append("</section>")

    def text(self, title: str) -> str:
        links = "\n".join(
            f'<a href="#s{k}">{name}</a>' for k, name in enumerate(self._titles, 1)
        )
        body = "\n".join(self._parts)
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            # a browser would ask a server for it
            '<link rel="icon" href="data:,">\n'
            f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
            f"<header>\n<h1>{escape(title)}</h1>\n<nav>\n{links}\n</nav>\n</header>\n"
            f"<main>\n{body}\n</main>\n"
            f'<footer class="note">Written by lpvlearn, {date.today()}.</footer>\n'
            "</body>\n</html>\n"
        )

    # -- words and tables ----------------------------------------------------------

    def note(self, text: str) -> None:
        self._parts.append(f'<p class="note">{escape(text)}</p>')

    def preformatted(self, text: str) -> None:
        self._parts.append(f'<pre class="text">{escape(text)}</pre>')

    def code(self, text: str) -> None:
        self._parts.append(f'<pre class="code"><code>{escape(text)}</code></pre>')

    def warnings(self, messages: list[str], none: str) -> None:
        if not messages:
            return self.note(none)
        items = "\n".join(f"<li>{escape(message)}</li>" for message in messages)
        self._parts.append(f'<ul class="warnings">\n{items}\n</ul>')

    def table(self, table: pd.DataFrame) -> None:
        """A table of strings; an index without a name is not shown."""
        named = table.index.name is not None
        heads = [table.index.name] * named + [self._named(c) for c in table.columns]
        lines = ["".join(f'<th scope="col">{escape(str(h))}</th>' for h in heads)]
        for label, row in zip(table.index, table.to_numpy(), strict=True):
            first = f'<th scope="row">{escape(self._named(label))}</th>' * named
            lines.append(first + "".join(f"<td>{escape(str(v))}</td>" for v in row))
        head, *rows = (f"<tr>{line}</tr>" for line in lines)
        body = "\n".join(rows)
        self._parts.append(
            '<div class="scroll"><table>\n'
            f"<thead>{head}</thead>\n<tbody>\n{body}\n</tbody>\n</table></div>"
        )

    def _named(self, name: Hashable) -> str:
        return with_unit(name, self._units.get(str(name)))

    # -- figures -------------------------------------------------------------------

    @contextmanager
    def _figures(self) -> Iterator[None]:
        self._parts.append('<div class="figures">')
        yield
        self._parts.append("</div>")

    @contextmanager
    def _axes(
        self, caption: str, shape: tuple[int, int] = (1, 1), *, wide: bool = False
    ) -> Iterator[Any]:
        """Axes (an array where there are several) of a figure that joins the page.

        It takes the width of the page where there are several columns.
        """
        from matplotlib import rc_context
        from matplotlib.figure import Figure

        rows, columns = shape
        wide |= columns > 1
        size = (
            _WIDTH * (min(max(columns, 2), 3) if wide else 1),
            _HEIGHT if rows == 1 else _ROW * rows,
        )
        with rc_context({"svg.fonttype": "none", "svg.hashsalt": "lpvlearn"}):
            figure = Figure(size, layout="constrained")
            axes = figure.subplots(rows, columns, squeeze=False, sharex="col")
            yield axes[0, 0] if rows == columns == 1 else axes
            drawn = io.StringIO()
            figure.savefig(drawn, format="svg", transparent=True)
        self._n_figures += 1
        if self._folder is not None:
            words = re.sub(r"[^\w.]+", " ", caption.split(";")[0].split(":")[0])
            name = "_".join(textwrap.shorten(words, _NAME, placeholder="").split())
            path = self._folder / f"{self._n_figures:02d}_{name}.svg"
            path.write_text(drawn.getvalue(), encoding="utf-8")
        kind = ' class="wide"' if wide else ""
        scroll = ('<div class="scroll">', "</div>") if wide else ("", "")
        self._parts.append(
            f"<figure{kind}>\n{scroll[0]}"
            f"{_inline(drawn.getvalue(), f'f{self._n_figures}-', caption, size[0])}"
            f"{scroll[1]}\n"
            f"<figcaption>{escape(caption)}</figcaption>\n</figure>"
        )

    def parameters(self, pipeline: Any) -> None:
        if pipeline.operating_points_.shape[1] > 2:
            return self.note("Drawn for one or two scheduling variables only.")
        names = list(pipeline.parameters_)[:_MOST_FIGURES]
        with self._figures():
            for name in names:
                with self._axes(f"{name} at the operating points") as ax:
                    ParameterDisplay.from_estimator(
                        pipeline, names=[name], units=self._units, ax=ax
                    )
        self._left_out(len(pipeline.parameters_.columns), "parameters")

    def responses(self, pipeline: Any) -> None:
        points, lpv = pipeline.operating_points_, pipeline.lpv_
        with self._figures():
            if lpv.order:
                caption = "Poles over the scheduling variable; rings: the local models"
                with self._axes(caption, (1, points.shape[1])) as axes:
                    PoleDisplay.from_estimator(pipeline, units=self._units, ax=axes)
            if points.shape[1] <= 2:
                with self._axes("What the model does not know, over its range") as ax:
                    UncertaintyDisplay.from_estimator(
                        pipeline, units=self._units, ax=ax
                    )
            # the first operating point, the middle one and the last
            for k in sorted({0, len(points) // 2, len(points) - 1}):
                place = as_shown(pipeline.report_.index[k], LABEL)
                shape = (lpv.n_outputs, lpv.n_inputs)
                with self._axes(f"Gain at operating point {place}", shape) as axes:
                    BodeDisplay.from_estimator(
                        pipeline,
                        kappa=points[k],
                        uncertainty=lpv.covariance is not None,
                        units=self._units,
                        ax=axes,
                    )

    def simulations(
        self, pipeline: Any, X: Any, y: Any, initial_state: InitialState
    ) -> None:
        with collected() as told:
            report = fit_report(pipeline, X, y, initial_state=initial_state)
        self.table(readable_report(report))
        start = "from rest" if initial_state == "rest" else "from estimated states"
        self.note(f"Simulated {start}. BFT and VAF in percent, 100 is perfect.")
        self.warnings(list(dict.fromkeys(t.message for t in told)), "")
        units = [self._units.get(str(name), "") for name in pipeline.output_names_]
        labels = list(dict.fromkeys(report["experiment"]))
        banded = initial_state == "rest" and pipeline.lpv_.covariance is not None
        several = Table(X).one(pipeline.experiment, "experiment") is not None
        with self._figures(), collected():  # the same warnings
            for label in labels[:_MOST_FIGURES]:
                shape = (pipeline.n_outputs_, 1)
                alone = len(labels) == 1
                with self._axes(f"Experiment {label}", shape, wide=alone) as axes:
                    SimulationDisplay.from_estimator(
                        pipeline,
                        X,
                        y,
                        experiment=label if several else None,
                        initial_state=initial_state,
                        uncertainty=banded,
                        units=units,
                        ax=axes,
                    )
        self._left_out(len(labels), "experiments")

    def residuals(self, pipeline: Any, X: Any, y: Any) -> None:
        shape = (pipeline.n_outputs_, 1 + pipeline.lpv_.n_inputs)
        caption = (
            "Correlations of the errors with themselves and with the inputs: beyond "
            "the band at positive lags the model lacks something"
        )
        before = len(self._parts)
        with collected() as told:
            try:
                with self._axes(caption, shape) as axes:
                    display = ResidualDisplay.from_estimator(pipeline, X, y, ax=axes)
            except ValueError as error:  # short records
                del self._parts[before:]
                return self.note(f"Not available: {error}")
        tests = display.tests
        shown = pd.DataFrame(
            {
                "output": tests["output"],
                "test": tests["test"],
                "input": tests["input"],
                "p-value": [as_shown(float(p), "{:.2g}") for p in tests["p_value"]],
                "passed": np.where(tests["passed"], "yes", "no"),
            }
        )
        self.table(shown)
        self.warnings(list(dict.fromkeys(t.message for t in told)), "")
        self.note(
            "With measurement noise alone the errors are white and independent of the "
            "inputs. On the samples of the fit the tests are a little too lenient."
        )

    def _left_out(self, n: int, what: str) -> None:
        if n > _MOST_FIGURES:
            self.note(f"The first {_MOST_FIGURES} of {n} {what} are drawn.")


def _inline(svg: str, prefix: str, caption: str, width: float) -> str:
    """An SVG file as an element of a page: no names of its own, no addresses."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    # equal colour bars are equal images, of equal names
    svg = re.sub(r'(<image [^>]*?) id="[^"]*"', r"\1", svg)
    for mark in ('id="', "url(#", 'xlink:href="#'):
        svg = svg.replace(mark, mark + prefix)
    label = f'<svg role="img" aria-label="{escape(caption)}"'
    label += f' style="max-width: {1.25 * width:g}in"'  # letters as large as the text
    return svg.replace("<svg", label, 1).replace("xlink:href", "href").strip()


def _versions() -> pd.DataFrame:
    found = {"Python": platform.python_version(), "lpvlearn": own_version()}
    found |= {package: version(package) for package in _PACKAGES}
    return pd.DataFrame({"version": found}).rename_axis("package")


# -- the reproducing code ----------------------------------------------------------


def reproducing_code(pipeline: Any) -> str:
    """Python that fits the pipeline again: its options and roles, not its data."""
    imports: dict[str, set[str]] = {}
    step = getattr(pipeline.restructurer, "structure", None)
    made = _expression(pipeline, imports)
    lines = []
    if isinstance(step, GrayBoxStructure):
        lines = [f"structure = {_structure_code(step)}", ""]
        imports.setdefault("lpvlearn", set()).add("GrayBoxStructure")
    lines += [f"pipeline = {made}", *_data_code(pipeline), "pipeline.fit(X, y)"]
    heads = ["import pandas as pd"]
    heads += [
        f"from {module} import {', '.join(sorted(names))}"
        for module, names in sorted(imports.items())
    ]
    return "\n".join([*heads, "", *lines])


def _data_code(pipeline: Any) -> list[str]:
    columns = getattr(pipeline, "feature_names_in_", None)
    if columns is None:
        shape = f"(n_samples, {pipeline.n_features_in_})"
        return [f"X, y = ...  # arrays: X of shape {shape}, y of the outputs"]
    outputs = list(pipeline.output_names_)
    chosen = repr(outputs[0]) if len(outputs) == 1 else repr(outputs)
    return [
        'table = pd.read_csv("table.csv")  # yours',
        f"X, y = table[{list(map(str, columns))!r}], table[{chosen}]",
    ]


def _expression(value: Any, imports: dict[str, set[str]]) -> str:
    """Code of an estimator with the options that are not its defaults."""
    if isinstance(value, GrayBoxStructure):
        return "structure"
    if isinstance(value, StateSpace):
        imports.setdefault("lpvlearn", set()).add("StateSpace")
        given = [_literal(M) for M in (value.A, value.B, value.C, value.D)]
        given += [repr(value.sampling_time), _literal(value.input_delay)]
        return f"StateSpace({', '.join(given)})"
    if not isinstance(value, BaseEstimator):
        return _literal(value)
    kind = type(value)
    public = [part for part in kind.__module__.split(".") if not part.startswith("_")]
    own = public[0] == __name__.split(".")[0]
    module = public[0] if own else ".".join(public)
    imports.setdefault(module, set()).add(kind.__name__)
    defaults = inspect.signature(kind).parameters
    given = []
    for name, option in value.get_params(deep=False).items():
        known = defaults[name].default if name in defaults else inspect.Parameter.empty
        if name not in _IMMATERIAL and repr(option) != repr(known):
            given.append(f"{name}={_expression(option, imports)}")
    if len(given) <= 1:
        return f"{kind.__name__}({', '.join(given)})"
    inner = ",\n".join(given).replace("\n", "\n    ")
    return f"{kind.__name__}(\n    {inner},\n)"


def _literal(value: Any) -> str:
    """A value as Python reads it: arrays as lists, and infinity by its name."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float) and not np.isfinite(value):
        return f"float({str(value)!r})"
    if type(value) is dict:
        items = (f"{_literal(k)}: {_literal(v)}" for k, v in value.items())
        return f"{{{', '.join(items)}}}"
    if type(value) is list:
        return f"[{', '.join(map(_literal, value))}]"
    if type(value) is tuple:
        return f"({', '.join(map(_literal, value))}{',' * (len(value) == 1)})"
    return repr(value)


def _structure_code(structure: GrayBoxStructure) -> str:
    """The template of an affine structure; for others, what is known of them."""
    names = structure.parameter_names
    if structure.offset is None or structure.basis is None:
        return f"...  # yours: {structure!r}, parameters {', '.join(names)}"
    cells = [
        [
            _cell(structure.offset[i, j], structure.basis[:, i, j], names)
            for j in range(structure.offset.shape[1])
        ]
        for i in range(len(structure.offset))
    ]
    n = structure.order
    blocks = {
        "A": [row[:n] for row in cells[:n]],
        "B": [row[n:] for row in cells[:n]],
        "C": [row[:n] for row in cells[n:]],
        "D": [row[n:] for row in cells[n:]],
    }
    given = ""
    for name, block in blocks.items():
        rows = ("\n" + 8 * " ").join(f"{row!r}," for row in block)
        given += f"    {name}=[\n        {rows}\n    ],\n"
    code = (
        "GrayBoxStructure.from_template(\n"
        f"{given}    parameter_names={list(names)!r},\n)"
    )
    bounded = {
        name: tuple(None if np.isinf(x) else float(x) for x in pair)
        for name, *pair in zip(names, structure.lower, structure.upper, strict=True)
        if np.isfinite(pair).any()
    }
    ranges = {
        name: tuple(map(float, pair))
        for name, pair in zip(names, structure.ranges.T, strict=True)
        if np.isfinite(pair).all()
    }
    code += f".with_bounds({bounded!r})" if bounded else ""
    return code + (f".with_ranges({ranges!r})" if ranges else "")


def _cell(
    constant: float, factors: NDArray[np.float64], names: tuple[str, ...]
) -> float | str:
    """An entry of a template, exact to the last digit."""
    text = "" if constant == 0 else repr(float(constant))
    for factor, name in zip(factors, names, strict=True):
        if factor:
            size = "" if abs(factor) == 1 else f"{abs(float(factor))!r}*"
            sign = "-" if factor < 0 else "+" if text else ""
            text += f"{sign}{size}{name}"
    if not factors.any():
        return float(constant)
    return text
