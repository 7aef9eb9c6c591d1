"""A folder with tables of the spring, its structure, and what ``fit`` made of them."""

import contextlib
import io

import pytest

from lpvlearn.__main__ import main

from ..conftest import spring_sweep, spring_tables

STRUCTURE = """
A = [[0, 1], ["-k", "-c"]]
B = [[0], ["b"]]
C = [[1, 0]]

[bounds]
k = [0, inf]

[units]
position = "m"
k = "1/s2"
"""

ROLES = [
    *("--inputs", "force", "--outputs", "position", "--scheduling", "kappa"),
    *("--experiment", "run", "--time", "time", "--order", "2", "--quiet"),
]


def run(*arguments):
    """Exit status, standard output and error of a command."""
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = end.code
    assert "Traceback" not in error.getvalue()
    return status, out.getvalue(), error.getvalue()


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """runs.csv, sweep.csv, spring.toml, and the results of a fit in spring/."""
    folder = tmp_path_factory.mktemp("command")
    X, y = spring_tables(n_samples=300)
    X.join(y).assign(extra=0.0).to_csv(folder / "runs.csv", index=False)
    X, y = spring_sweep(300)
    X.join(y).to_csv(folder / "sweep.csv", index=False)
    (folder / "spring.toml").write_text(STRUCTURE)
    options = ["--structure", folder / "spring.toml", "--output", folder / "spring"]
    options += ["--validation", folder / "sweep.csv"]
    assert run("fit", folder / "runs.csv", *ROLES, *options) == (0, "", "")
    return folder
