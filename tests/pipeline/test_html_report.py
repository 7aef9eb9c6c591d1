"""The HTML page of a fitted pipeline stands alone, and its code makes the model."""

import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    load,
    save,
)
from lpvlearn.pipeline.reports.html_report import _expression, reproducing_code

from ..conftest import ROLES, spring_pipeline, stable_model

# Elements without an end
VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(HTMLParser):
    """Checks that elements close in order; keeps their attributes and texts."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.texts = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, *pair) for pair in attributes]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.attributes += [(tag, *pair) for pair in attributes]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.texts.append(text)


def page_of(pipeline, path, *tables, **options):
    pipeline.to_html_report(path, *tables, **options)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert not page.open
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(set(ids)) == len(ids)
    assert "http" not in text and "<script" not in text and "@import" not in text
    for _, name, value in page.attributes:
        if name in ("href", "src"):
            assert value.startswith("data:") or value[1:] in ids
    assert list(path.parent.iterdir()) == [path]
    return page, text


@pytest.fixture(scope="module")
def fitted(spring):
    return spring_pipeline(local=SubspaceLTI(2, horizon=8)).fit(*spring[:2])


@pytest.mark.slow
def test_page_stands_alone_and_tells_what_the_tables_tell(fitted, spring, tmp_path):
    X, y = spring[2:]
    page, text = page_of(
        fitted, tmp_path / "report.html", X[:600], y[:600], units={"position": "mm"}
    )
    for words in (
        "gray-box BFT",
        "kappa from 0 to 1.5",
        "sweep",
        "whiteness",
        "± 2 std",
    ):
        assert words in text
    assert any("position (mm)" in words for words in page.texts)
    figures = [words for words in page.attributes if words[:2] == ("svg", "role")]
    # parameters, poles, what is not known, gains, sweep, errors
    assert len(figures) == 3 + 1 + 1 + 3 + 1 + 1


@pytest.mark.slow
def test_units_of_the_pipeline_reach_its_pages_pictures_and_files(spring, tmp_path):
    X, y = spring[:2]
    units = {"position": "mm", "kappa": "kg", "force": "N", "k": "1/s2"}
    local = SubspaceLTI(2, horizon=8)
    pipeline = spring_pipeline(local=local, units=units).fit(X, y)
    save(pipeline, tmp_path / "model.zip")
    loaded = load(tmp_path / "model.zip")
    assert loaded.lpv_.units == loaded.lpv_.at(0.5).units == units
    for model in (
        loaded.lpv_.at(0.5),
        *loaded.local_models_,
        *loaded.structured_models_,
    ):
        assert (model.input_names, model.output_names) == (["force"], ["position"])
        assert model.units == units
    (tmp_path / "model.zip").unlink()
    text = page_of(loaded, tmp_path / "report.html", X[:300], y[:300])[1]
    for words in ("position (mm)", "k (1/s2)", "κ (kg)", "force (N)"):
        assert words in text
    bad = spring_pipeline(units=["mm"])
    with pytest.raises(ValueError, match="`units` must be a dict from names"):
        bad.fit(X, y)


@pytest.mark.slow
def test_without_a_table_it_tells_of_the_fit_alone(fitted, tmp_path):
    text = page_of(fitted, tmp_path / "report.html", title="A < B & C")[1]
    assert "<title>A &lt; B &amp; C</title>" in text
    assert "The fit gave no warnings." in text
    assert "Measured and simulated" not in text


def test_a_table_without_its_outputs_is_refused(fitted, spring, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("the old one")
    with pytest.raises(ValueError, match="`y` must come with `X`"):
        fitted.to_html_report(path, spring[0])
    assert path.read_text() == "the old one"


@pytest.mark.slow
def test_names_are_text_and_warnings_are_kept_with_their_remedies(tmp_path, spring):
    X, y = spring[:2]
    X = X.rename(columns={"force": "<b>F</b>"})
    y = y.rename(columns={"position": "x & <y>"})
    local = SubspaceLTI(2, horizon=8)
    pipeline = LocalLPVPipeline(local, inputs="<b>F</b>", offsets=None, **ROLES)
    with pytest.warns(UserWarning) as caught:
        pipeline.fit(X, y + 20.0)
    assert pipeline.warnings_ == [str(w.message) for w in caught]
    assert all(w.filename == __file__ for w in caught)
    page, text = page_of(pipeline, tmp_path / "report.html")
    assert all(message in page.texts for message in pipeline.warnings_)
    assert "<b>" not in text
    assert any("x & <y>" in words for words in page.texts)


@pytest.mark.slow
def test_several_inputs_outputs_and_scheduling_variables(tmp_path):
    rng = np.random.default_rng(0)
    model = stable_model(1, 2, 2, 2)
    tables, outputs = [], []
    for k, place in enumerate([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]):
        u = rng.standard_normal((200, 2))
        X = pd.DataFrame(u, columns=["u1", "u2"])
        tables.append(X.assign(a=place[0], b=place[1], run=k))
        outputs.append(model.simulate(u, sampling_time=0.1))
    X = pd.concat(tables, ignore_index=True)
    roles = {"scheduling": ["a", "b"], "experiment": "run", "sampling_time": 0.1}
    pipeline = LocalLPVPipeline(SubspaceLTI(2, horizon=5), **roles)
    y = np.vstack(outputs)
    pipeline.fit(X, y)
    text = page_of(pipeline, tmp_path / "report.html", X, y)[1]
    assert "Drawn for" not in text
    assert text.count("Poles over the scheduling variable") == 2  # name and caption


def test_its_code_makes_the_same_model(fitted, spring, tmp_path, monkeypatch):
    X, y = spring[:2]
    monkeypatch.chdir(tmp_path)
    X.assign(position=y).to_csv("table.csv", index=False)
    found = {}
    exec(reproducing_code(fitted), found)
    # but for what other programs make of decimals
    assert_allclose(found["pipeline"].parameters_, fitted.parameters_, rtol=1e-9)


def test_its_code_writes_templates_exactly():
    structure = GrayBoxStructure.from_template(
        [["0.1*a - 3", "-b"], [1, "a + 2*b"]], [["b / 3"], [1e-17]], [[1, 0]]
    ).with_bounds({"a": (0, None)})
    pipeline = LocalLPVPipeline(restructurer=GrayBoxRestructurer(structure))
    pipeline.n_features_in_ = 1
    found = {}
    exec(reproducing_code(pipeline).split("pipeline =")[0], found)
    again = found["structure"]
    assert_array_equal(again.offset, structure.offset)
    assert_array_equal(again.basis, structure.basis)
    assert_array_equal(again.lower, structure.lower)
    assert again.parameter_names == structure.parameter_names


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs a browser")
def test_a_browser_shows_it_without_complaint(fitted, spring, tmp_path):
    path = tmp_path / "report.html"
    fitted.to_html_report(path, *spring[2:])
    browser = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu"]
    logging = ["--enable-logging=stderr", f"--user-data-dir={tmp_path / 'browser'}"]
    told = subprocess.run(
        [*browser, *logging, "--dump-dom", path.as_uri()],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "CONSOLE" not in told.stderr
    assert told.stdout.count("<svg") == path.read_text(encoding="utf-8").count("<svg")


@pytest.mark.parametrize(
    "step",
    [
        GrayBoxRestructurer(init=np.ones(3)),
        SubspaceLTI(np.int64(3)),
        GrayBoxRestructurer(frequency_weight=(0.1, np.inf)),
        GrayBoxRestructurer(frequency_weight=StateSpace(-1.0, 1.0, 1.0)),
    ],
    ids=str,
)
def test_its_code_is_python_whatever_the_options(step):
    known = {kind.__name__: kind for kind in (type(step), StateSpace)}
    again = eval(_expression(step, {}), known)
    for name, option in step.get_params().items():
        as_lists = option.tolist() if isinstance(option, np.ndarray) else option
        assert str(again.get_params()[name]) == str(as_lists)


def test_a_folder_that_is_not_there_is_told(fitted, spring, tmp_path):
    with pytest.raises(FileNotFoundError, match="`path` .*page.html.*Make the folder"):
        fitted.to_html_report(tmp_path / "none" / "page.html")
